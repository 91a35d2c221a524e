"""What is in the page: predictions that are true, every section filled, nothing loaded from anywhere."""

import dataclasses
import json
import re
from importlib.resources import files
from typing import ClassVar

import numpy as np
import pytest
from helpers import assert_holds
from hypothesis import given
from hypothesis import strategies as st
from reading_html import Page
from results_folder import NAMES, Draws, changed, discovery

from mcc_jax._format import interval, number, with_sd
from mcc_jax.discovery import Discovery
from mcc_jax.discovery.sentences import headline
from mcc_jax.report import read_results, report_page
from mcc_jax.report.chart import chart_items, compare
from mcc_jax.report.checks import check_results
from mcc_jax.report.story import Example, example_pictures
from mcc_jax.report.texts import calibration_sentences, next_steps

SECTIONS = {"summary", "measured", "law", "compare", "posterior", "diagnostics", "discovery", "settings", "cite"}
ALWAYS = {"summary", "law", "settings", "cite"}
OF_PART = {
    "campaign": {"compare", "measured"},
    "calibration": {"posterior", "measured", "diagnostics", "compare"},
    "posterior": set(),
    "discovery": {"discovery", "diagnostics"},
}
"""Sections that are in a page only where there is something to show."""
PARTS = {
    "campaign": ("particles.csv", "curves.csv", "campaign.toml"),
    "calibration": ("calibration.json", "calibration.msgpack"),
    "posterior": (),
    "discovery": ("discovery.json", "discovery.msgpack"),
}


def text_of(results):
    return Page(report_page(results)).text


def keep(folder, *parts):
    """Leave only these parts in the folder, and nothing that points elsewhere."""
    for part in set(PARTS) - set(parts):
        for name in PARTS[part]:
            (folder / name).unlink()
    for name in ("calibration.json", "discovery.json"):
        (folder / name).unlink(missing_ok=True)
    if "calibration" in parts and "posterior" not in parts:
        changed(folder, method="least-squares")


class WithWhatWasFound(Draws):
    """The posterior of the law with what was found: half a micrometre off that of the law alone."""

    problems: ClassVar[tuple[str, ...]] = ()

    def to_json(self):
        return super().to_json() | {"effects": discovery()["effects"]}

    def failures(self):
        return self.problems

    def predictions(self, particle):
        return super().predictions(particle) + 0.5


class NotConverged(WithWhatWasFound):
    problems = ("R-hat 1.2",)


def with_posterior_of_the_found(results, kind):
    saved = results.saved
    posterior = kind(saved.campaign, results.calibration, saved.of_a)
    found = Discovery("NAMED", results.discovery["summary"], None, None, 0, 0.0)
    object.__setattr__(found, "posterior", posterior)  # a stand-in: that of a discovery would take a minute
    return dataclasses.replace(results, found=found)


def test_the_page_is_of_the_law_with_what_was_found_where_that_may_be_believed(results):
    found = with_posterior_of_the_found(results, WithWhatWasFound)
    alone, added = compare(found), compare(found.with_discovery)
    for one, other in zip(alone[:-1], added[:-1], strict=True):
        np.testing.assert_allclose((other.own_um - one.own_um)[one.used], 0.5, atol=1e-6)
    page, before = report_page(found), report_page(results)
    for words in (
        "Calibration of the law with frame compliance",
        "Parameters of the law with frame compliance",
        "Figures of the law alone",
    ):
        assert words in page
        assert words not in before
    assert "<strong>frame compliance</strong> (in the form “linear”): <i>d</i> = <i>C</i> <i>F</i>" in page
    assert "law alone, which lacks" not in page
    step = found.discovery["gap"]["steps"][-1]
    for chi2, answer in ((1.0, "nothing more is missing"), (2.0, "part is missing")):
        step["chi2_per_dof"] = chi2
        checks = {one.check: one for one in check_results(found.with_discovery, added)}
        assert (checks["Law is complete"].value, len(checks)) == (answer, len(check_results(found, alone)))
    for other in (results, with_posterior_of_the_found(results, NotConverged)):
        assert other.with_discovery is other
        assert "Effects that discovery added are not in these lines" in report_page(other)
    content = found.calibration | {"effects": [{"mechanism": "creep"}]}
    other = with_posterior_of_the_found(dataclasses.replace(results, calibration=content), WithWhatWasFound)
    assert other.with_discovery is other


def test_sections_are_filled_and_the_page_is_whole(page):
    read = Page(page)
    assert set(read.sections) == SECTIONS
    assert len(read.ids) == len(set(read.ids))
    assert {link[1:] for link in read.links if link.startswith("#")} <= set(read.ids)
    assert all(image["alt"].strip() for image in read.images)
    assert dict(read.tags[0][1]) == {"lang": "en"}
    found = ["frame compliance", "platen sink in", "a hold of 60 s", "0.004000 ± 0.000010", "99 %", "1.43"]
    assert_holds(read.text, [*found, *NAMES[1:]])
    assert "has 3 usable points on loading" in read.sections["measured"]
    assert "checksums agree" in read.sections["diagnostics"]
    assert "arXiv:1812.06173" in read.sections["cite"]
    assert len(page.encode()) < 6e6


def test_nothing_is_loaded_from_anywhere(page):
    read = Page(page)
    assert all(source.startswith("data:image/") for source in read.sources)
    assert [link for link in read.links if not link.startswith("#")] == ["https://arxiv.org/abs/1812.06173"]
    policy = next(a["content"] for tag, a in read.tags if tag == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy
    assert "url(" not in page[: page.index("</style>")]
    for tag, attributes in read.tags:
        assert tag not in ("base", "link", "iframe", "frame", "object", "embed", "audio", "video", "source", "form")
        loads = [v for k, v in attributes.items() if k in LOADING and not (tag == "a" and k == "href")]
        assert all(value.startswith(("data:image/", "#")) for value in loads), (tag, attributes)
        assert "url(" not in attributes.get("style", "")
    assert not others(page)
    # Bokeh's script as it is shipped loads fonts of formulas and maps.
    assert len(others(files("bokeh").joinpath("server", "static", "js", "bokeh.min.js").read_text("utf-8"))) >= 2


LOADING = ("src", "srcset", "href", "xlink:href", "data", "poster", "background", "action", "formaction", "ping")
# Addresses that a page may hold since nothing loads them: names of languages of markup, licences in comments of Bokeh's
# script, and links that a reader may click.
HARMLESS = re.compile(
    r"https?://(www\.w3\.org/(2000/svg|1999/xhtml|1999/xlink|1998/Math/MathML)|arxiv\.org/abs/1812\.06173"
    r"|github\.com/(mourner/flatbush|tabler/tabler-icons/blob/master/LICENSE)|tabler\.io|jquery\.org/license"
    r"|www\.foretagsplatsen\.se|bokeh\.org/|docs\.bokeh\.org/en/latest/docs/user_guide/interaction/tools\.html(#[\w-]+)?"
    r"|developers\.google\.com/maps/documentation/javascript/get-api-key)?"
)


def others(text):
    """Addresses in other places than this machine that a text holds, but for the harmless ones."""
    found = re.findall(r"""(?:https?|wss?|ftp):\\?/\\?/[^"'`\s<>)\\]*""", text)
    return {a.rstrip(".,") for a in found if not re.fullmatch(HARMLESS, a.rstrip(".,")) and "//localhost:" not in a}


@pytest.mark.parametrize(
    "parts",
    [
        ("campaign",),
        ("calibration",),
        ("discovery",),
        ("campaign", "calibration"),
        ("calibration", "posterior"),
        ("campaign", "discovery"),
    ],
    ids="+".join,
)
def test_what_is_missing_is_said_with_the_command_that_makes_it(folder, parts):
    keep(folder, *parts)
    found = read_results(folder)
    saved = {"campaign"} if "calibration" in parts else set()  # a saved calibration holds its tests
    assert len(found.missing) == len(set(PARTS) - set(parts) - saved)
    read = Page(report_page(found))
    assert set(read.sections) == ALWAYS.union(*(OF_PART[part] for part in parts))
    assert {link[1:] for link in read.links if link.startswith("#")} <= set(read.ids)
    for name, text in read.sections.items():
        assert len(text.split()) > 10, (name, text)
    commands = {"campaign": "--campaign CAMPAIGN", "discovery": "mcc-jax discover", "posterior": "mcc-jax calibrate"}
    for part, command in commands.items():
        if part not in (*parts, *saved):
            assert command in read.text
    assert ("chart-data" in read.ids) == ("campaign" in (*parts, *saved))


@pytest.mark.parametrize(
    ("verdict", "sentence", "words"),
    [
        ("NO_GAP", "nothing is missing from the law", "Nothing missing"),
        ("NAMED", "The law misses frame compliance", "Effect identified: frame compliance"),
        ("SET", "or what looks like it", "Effect not unique: frame compliance or what looks like it"),
        ("UNLISTED", "no listed mechanism explains", "Unlisted effect"),
        ("FIT_NOT_CONVERGED", "could not be fitted well enough", "could not be fitted"),
    ],
)
def test_every_verdict_is_reported(folder, verdict, sentence, words):
    keep(folder, "discovery")
    empty = {"effects": [], "candidate_set": [], "where": [], "next_experiments": [], "parameters_after": {}}
    closure = {"formula": "0.1 * x**2", "resembles": [["creep", 0.7]], "selection_frequency": 0.9}
    more = {"NO_GAP": empty, "UNLISTED": empty | {"closure": closure}, "FIT_NOT_CONVERGED": empty | {"ranking": []}}
    sections = Page(
        report_page(changed(folder, "discovery.msgpack", verdict=verdict, **more.get(verdict, {})))
    ).sections
    assert sentence in sections["summary"]
    assert words in sections["discovery"]
    assert ("0.1 * x**2" in sections["discovery"]) == (verdict == "UNLISTED")


def test_the_first_screen_tells_verdict_gap_and_modulus(page):
    """A share of the gap is nowhere without chi2 per point."""
    read = Page(page)
    assert list(read.sections) == [name for name in ORDER if name in read.sections]
    top = read.sections["summary"]
    assert_holds(
        top, ["The law misses frame compliance", "16.000000 ± 0.000010 GPa", "9.000 ± 0.050 GPa", "78 % higher"]
    )
    assert top.index("The law misses") < top.index("Gap closed") < top.index("Effective modulus")
    for section in ("summary", "discovery"):
        text = " ".join(read.sections[section].split())
        place = text.index("99 %")
        assert "χ² per point" in text[place : place + 200]
        assert "falls from 2 to 2" in text[place : place + 300]
    assert not [word for word in UNDERSCORED.findall(read.text) if word not in ALLOWED]
    numbers = "effectivemodulus[GPa]9.000±0.0508.902to9.09816.000000±0.000010"  # before and after, with intervals
    assert numbers in "".join(read.sections["discovery"].split())


ORDER = ("summary", "compare", "law", "posterior", "diagnostics", "discovery", "measured", "settings", "cite")
UNDERSCORED = re.compile(r"[A-Za-z]+_[A-Za-z_]+")
# The package, a formula, and a column that a user must call so.
ALLOWED = {"mcc_jax", "D_e", "relative_humidity_percent"}


def test_no_line_breaks_within_a_number_and_commands_can_be_copied(folder):
    results = dataclasses.replace(read_results(folder), name="tests of 5 mN")
    page = report_page(results).replace("\N{NO-BREAK SPACE}", "~")
    assert "16.000000~±~0.000010~GPa" in page
    assert "mcc-jax calibrate CAMPAIGN --out &#39;tests of 5 mN&#39;" in report_page(
        dataclasses.replace(results, calibration=None, saved=None)
    )


@pytest.mark.parametrize("gap_at", [5, 30, 55])
def test_the_enlarged_part_holds_the_largest_gap(gap_at):
    """A test of rising load whose law is wrong in one place."""
    rows = np.arange(60.0)
    before = np.where(np.abs(rows - gap_at) < 4, 0.5, 0.0)
    example = Example(rows, rows**2, rows, before, "Particle 1.", after_um=0 * rows, added="law with creep")
    assert example.near[gap_at]
    assert example.near.sum() < 20
    few = Example(*(np.arange(4.0) for _ in range(4)), "")
    assert few.near.sum() > 1  # of a record with few readings more is shown, never one
    assert [look["label"] for _, look in example.laws] == ["law alone", "law with creep"]
    for source, words in example_pictures(example):
        assert source.startswith("data:image/svg+xml")
        assert "Particle 1" in words


@pytest.mark.parametrize(("chi2", "words"), [(1.02, "agree within the noise"), (1.4, "part remains")])
def test_a_gap_is_called_closed_only_where_chi2_says_so(chi2, words):
    content = discovery(verdict="NAMED")
    content["gap"]["steps"][-1]["chi2_per_dof"] = chi2
    assert words in headline(content)


@pytest.mark.parametrize(("power", "words"), [(0.95, "Next: a hold"), (0.3, "would reliably separate")])
def test_an_experiment_that_may_not_separate_is_not_simply_recommended(folder, power, words):
    keep(folder, "discovery")
    one = {"experiment": "a hold of 60 s at the largest load", "separates": ["frame_compliance", "creep"]}
    further = [{**one, "particles": 6, "power": power}]
    text = text_of(changed(folder, "discovery.msgpack", verdict="SET", next_experiments=further))
    assert words in text
    assert ("Next: a hold" in text) == (power > 0.9)


def test_what_would_show_each_candidate_by_itself_is_there(folder):
    keep(folder, "discovery")
    checks = [
        {"mechanism": "frame_compliance", "check": "press the bare platen"},
        {"mechanism": "platen_sink_in", "check": "repeat on diamond"},
    ]
    text = text_of(changed(folder, "discovery.msgpack", verdict="SET", next_experiments=[], checks=checks))
    assert "None is proposed" in text
    assert "(frame compliance: press the bare platen; platen sink in: repeat on diamond)" in text
    assert "checked directly" not in text_of(changed(folder, "discovery.msgpack", checks=[]))


def test_equal_input_gives_an_equal_page(complete, page):
    from bokeh.models import ColumnDataSource

    first = chart_items()
    ColumnDataSource({})  # moves Bokeh's own count
    assert chart_items() == first
    assert report_page(read_results(complete, name="complete")) == page


def test_the_page_needs_double_precision(results):
    import jax

    with jax.enable_x64(False), pytest.raises(RuntimeError, match="double precision"):
        report_page(results)


def test_changed_data_are_noticed(folder):
    assert read_results(folder).cautions == ()
    with (folder / "curves.csv").open("a") as stream:
        stream.write("\n")
    found = read_results(folder)
    assert [text.split(" was")[0] for text in found.cautions] == ["calibration.json", "discovery.json"]
    assert "curves.csv" in found.cautions[0]
    assert next(check.level for check in check_results(found) if check.check == "Same data") == "bad"


def test_json_of_another_run_is_left_out(folder):
    found = changed(folder, "calibration.json", runtime_s=17.0)
    assert "calibration.json is not of the calibration.msgpack next to it" in found.cautions[0]
    assert set(found.figures) == {"discovery_before_after"}


def test_the_campaign_is_found_where_the_results_say(without_posterior, tmp_path):
    folder = without_posterior
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in PARTS["campaign"]:
        if (folder / name).exists():
            (folder / name).rename(moved / name)
    origin = json.loads((folder / "calibration.json").read_text())["provenance"]
    origin["campaign"]["folder"] = str(moved)
    assert len(changed(folder, "calibration.json", provenance=origin).campaign) == len(NAMES)
    origin["campaign"]["folder"] = str(tmp_path / "gone")
    changed(folder, "calibration.json", provenance=origin)
    changed(folder, "discovery.json", provenance=origin)
    lost = read_results(folder)
    assert lost.checksums == {}  # the tests are those that the calibration holds
    assert "no longer where" in lost.missing_campaign
    assert len(read_results(folder, moved).campaign) == len(NAMES)
    moved.rename(folder / "campaign")
    assert len(read_results(folder).campaign) == len(NAMES)


def test_figures_are_only_those_that_the_results_name_as_theirs(folder):
    (folder / "figures" / "mine.png").write_bytes((folder / "figures" / "forest.png").read_bytes())
    (folder / "secret.png").write_bytes((folder / "figures" / "forest.png").read_bytes())
    (folder / "figures" / "pairs.png").write_text("no picture")
    names = ["figures/forest.png", "figures/../secret.png", "/etc/hostname", "figures/pairs.png", "figures/gone.png"]
    assert set(changed(folder, "calibration.json", figures=names).figures) == {"forest", "discovery_before_after"}


@pytest.mark.parametrize(
    ("check", "changes", "level"),
    [
        ("Chains agree (R-hat)", {"rhat_max": 1.01}, "good"),
        ("Chains agree (R-hat)", {"rhat_max": 1.02}, "look"),
        ("Chains agree (R-hat)", {"rhat_max": 1.2}, "bad"),
        ("Chains agree (R-hat)", {"rhat_max": None}, "unknown"),
        ("Independent draws (bulk ESS)", {"ess_bulk_min": 400}, "good"),
        ("Independent draws (bulk ESS)", {"ess_bulk_min": 399}, "look"),
        ("Independent draws (bulk ESS)", {"ess_bulk_min": 20}, "bad"),
        ("Diverging trajectories", {"divergences": 1}, "bad"),
        ("Fast mode is accurate (Pareto k)", {"pareto_k_max": 0.2, "pareto_k_joint": 0.9}, "look"),
        ("Fast mode is accurate (Pareto k)", {"pareto_k_max": 1.2}, "bad"),
        ("The law's form fits", {"own_misfit": 0.03}, "look"),
        ("The law's form fits", {"own_misfit": 0.2}, "bad"),
    ],
)
def test_checks_change_where_the_gates_are(results, check, changes, level):
    content = {**results.calibration, "diagnostics": results.calibration["diagnostics"] | changes}
    found = {one.check: one for one in check_results(dataclasses.replace(results, calibration=content))}
    assert found[check].level == level


def test_a_calibration_that_did_not_converge_is_no_green_page(folder):
    found = changed(folder, converged=False)
    assert check_results(found)[0].level == "bad"
    assert "NOT converge" in " ".join(calibration_sentences(found.calibration))
    assert "does not fit these tests" in next(next_steps(found))[0]
    text = Page(report_page(found)).sections["summary"]
    assert "Not converged" in text
    assert "problem" in text


@given(st.floats(-1e12, 1e12, allow_subnormal=False), st.integers(1, 6))
def test_numbers_are_what_they_say(value, digits):
    text = number(value, digits).replace("−", "-")
    if "×" in text:
        mantissa, exponent = text.split(" × 10")
        exponent = exponent.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
        text = f"{mantissa}e{exponent}"
    assert float(text) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits), abs=1e-300)


def test_digits_follow_the_uncertainty():
    assert with_sd({"value": 1.42893, "sd": 0.00153}) == "1.4289 ± 0.0015"
    assert with_sd({"value": 16012.7, "sd": 10.3}, 1e-3) == "16.013 ± 0.010"
    assert with_sd({"value": -3.0, "sd": None}) == "−3"
    assert with_sd({"value": None, "sd": None}) == "unknown"
    assert with_sd({"value": 5.785e-4, "sd": 2.5e-6}) == "(5.785 ± 0.025) × 10⁻⁴"
    assert interval({"interval_95": [1.42597, 1.43206]}) == "1.4260 to 1.4321"
    assert interval({"interval_95": None}) is None
