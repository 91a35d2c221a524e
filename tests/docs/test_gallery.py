"""The gallery of effects and the table of tests against effects agree with the library."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from mcc_jax.effects import LIBRARY

DOCS = Path(__file__).parents[2] / ".docs"
VARIANTS = [variant for mechanism in LIBRARY.values() for variant in mechanism]


@pytest.fixture(scope="module")
def docs():
    """The modules in the folder of the pages, by name."""
    sys.path.insert(0, str(DOCS))
    yield importlib.import_module
    sys.path.remove(str(DOCS))


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: f"{v.mechanism}:{v.name}")
def test_every_formula_becomes_tex(docs, variant):
    tex = docs("equations").in_tex(variant.equation)
    assert tex.count("{") == tex.count("}")
    bare = re.sub(r"\\(?:text|mathrm)\{[^{}]*\}|\\[A-Za-z]+|\\.", " ", tex)
    assert not re.search(r"[A-Za-z]{3,}", bare), tex  # what is longer than two letters is a command, a unit or a word


@pytest.mark.parametrize(
    ("text", "tex"),
    [
        ("d = C F (F / 100 mN)^(-1/3)", r"d = C F (F / 100\,\mathrm{mN})^{-1/3}"),
        ("C5^5 (1 + m ln(eps' / 0.002/s))", r"C_5^{5} (1 + m \ln (\dot{\epsilon} / 0.002\,\mathrm{s}^{-1}))"),
        ("a = D_e sqrt(c^2 sigma)", r"a = D_{e} \sqrt{c^{2} \sigma}"),
        ("E exp(-kappa eps_0) above eps_0", r"E \exp (-\kappa  \epsilon_{0}) \text{ above } \epsilon_{0}"),
    ],
)
def test_formulas_keep_their_meaning(docs, text, tex):
    assert docs("equations").in_tex(text) == tex


def test_the_stored_numbers_cover_all_mechanisms(docs):
    plans = docs("gallery").POWER["plans"]
    assert [docs("make_power").PLANS[name][0] for name in plans] == [plan["title"] for plan in plans.values()]
    for plan in plans.values():
        assert set(plan["limits"]) | set(plan["needs"]) == set(LIBRARY)
        assert not set(plan["limits"]) & set(plan["needs"])
        assert {name for pair in plan["alike"] for name in pair[:2]} <= set(plan["limits"])


def test_every_mechanism_is_in_the_tables(docs):
    gallery = docs("gallery")
    table = gallery.which_test().splitlines()
    assert len(table) == 2 + len(LIBRARY)
    assert len({line.count("|") for line in table}) == 1
    alike = gallery.look_alikes().splitlines()
    assert len({line.count("|") for line in alike}) == 1
    for name in LIBRARY:
        assert gallery.mistaken_for(name)


def test_an_entry_is_complete_and_shows_a_picture(docs, monkeypatch):
    gallery = docs("gallery")
    creep = LIBRARY["creep"]
    strength, most, *pictures = docs("effect_pictures").picture(creep)
    assert 1.0 < most < 20.0
    monkeypatch.setattr(gallery, "pictures", lambda: {"creep": (strength, most, *pictures)})
    entry = gallery.entry(creep)
    for picture in pictures:
        assert picture.startswith(b"\x89PNG")
        assert len(picture) < 60_000
    low, high = creep.variants[0].plausible
    assert low <= strength <= high
    said = [creep.explanation, creep.check, creep.variants[0].parameter]
    said += ["images/effects/creep.png", "images/effects/creep-added.png"]
    for variant in creep:
        said += [f"`{variant.name}`", variant.explanation, variant.source.rstrip(".")]
    assert [text for text in said if text not in entry] == []


@pytest.mark.extended
def test_a_plan_computed_again_gives_the_stored_numbers(docs):
    kept, again = docs("gallery").POWER["plans"]["load"], docs("make_power").worked_out("load")
    assert again["needs"] == kept["needs"]
    assert again["limits"] == pytest.approx(kept["limits"], rel=0.05)


def test_every_mechanism_is_listed_once_under_its_cause(docs, monkeypatch):
    gallery = docs("gallery")
    monkeypatch.setattr(gallery, "pictures", lambda: dict.fromkeys(LIBRARY, (1.0, 2.5)))
    sheet = gallery.sheet()
    assert sorted(re.findall(r"\(#(\w+)\)", sheet)) == sorted(LIBRARY)
    of_instrument = sheet.split("**")[2]
    assert re.findall(r"\(#(\w+)\)", of_instrument) == ["frame_compliance", "thermal_drift", "platen_sink_in"]
    assert "2.5 µm" in of_instrument
