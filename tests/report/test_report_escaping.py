"""Text that comes from data stays text, wherever it stands."""

import json

import pytest
from reading_html import Page
from results_folder import discovery, write_results

from mcc_jax.report import read_results, report_page

EVIL = (
    "<script>alert(1)</script>",
    "</script><script>alert(2)</script>",
    "<img src=x onerror=alert(3)>\"'&amp;",
    "<!--<script>{{ 7*7 }}",
)


@pytest.fixture(scope="module")
def evil(tmp_path_factory):
    """A folder in which every text is an attack."""
    folder = write_results(tmp_path_factory.mktemp("evil"), EVIL)
    (folder / "campaign.toml").write_text(f"provenance = {json.dumps(EVIL[1])}\n[other]\nx = 1\n", encoding="utf-8")
    for name in ("calibration.json", "discovery.json"):
        content = json.loads((folder / name).read_text(encoding="utf-8"))
        content["provenance"]["settings"] = {EVIL[0]: EVIL[1], "priors": EVIL[2]}
        content["provenance"]["versions"] = {EVIL[2]: EVIL[0]}
        content["provenance"]["campaign"]["sha256"] = {EVIL[0]: EVIL[1]}
        for key in ("warnings", "notes"):
            if key in content:
                content[key] = list(EVIL)
        if name == "calibration.json":
            content["particles"][-1]["why_not"] = EVIL[1]
            content["priors"] = {EVIL[0]: {"distribution": EVIL[1], EVIL[2]: 1.0}}
        else:
            content = evil_texts(content)
        (folder / name).write_text(json.dumps(content), encoding="utf-8")
        (folder / name).with_suffix(".msgpack").write_text(json.dumps(content), encoding="utf-8")
    return folder


def evil_texts(value, key=""):
    """The same with an attack in place of every text that a schema leaves free."""
    if isinstance(value, dict):
        return {k: evil_texts(v, k) for k, v in value.items()}
    if isinstance(value, list):
        return [evil_texts(v, key) for v in value]
    return EVIL[1] if isinstance(value, str) and key not in ("verdict", "figures") else value


def test_no_text_becomes_an_element(evil, page):
    attacked, harmless = Page(report_page(read_results(evil, name=EVIL[0]))), Page(page)
    count = [sum(tag == "script" for tag, _ in read.tags) for read in (attacked, harmless)]
    assert count[0] == count[1] == 3
    assert not [a for _, a in attacked.tags if any(name.startswith("on") for name in a)]
    assert all(source.startswith("data:image/") for source in attacked.sources)
    for text in (EVIL[0], EVIL[1], EVIL[3]):
        assert text in attacked.text, text
    assert discovery()["summary"] not in attacked.text


def test_names_come_whole_out_of_the_embedded_data(evil):
    read = Page(report_page(read_results(evil)))
    labels = [one["label"] for one in json.loads(read.script)["data"]["particles"]]
    assert labels == list(EVIL)
    for symbol in "<>&":
        assert symbol not in read.script
