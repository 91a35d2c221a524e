"""Equations of the library on a page: with Greek letters, indices and powers, and nothing lost."""

import re

import pytest

from mcc_jax.effects import LIBRARY
from mcc_jax.report.texts import GREEK, equation


def test_equations_are_written_with_greek_letters_indices_and_powers():
    assert equation("E exp(-kappa sigma_P / 10 MPa)") == "<i>E</i> exp(−<i>κ</i> <i>σ</i><sub>P</sub> / 10 MPa)"
    assert (
        equation("C1 (D_e / 200 um)^-n") == "<i>C</i><sub>1</sub> (<i>D</i><sub>e</sub> / 200 µm)<sup>−<i>n</i></sup>"
    )
    assert equation("v t (t / 100 s)^(1/2)") == "<i>v</i> <i>t</i> (<i>t</i> / 100 s)<sup>1/2</sup>"
    assert equation("<b>F</b>") == "&lt;<i>b</i>&gt;<i>F</i>&lt;/<i>b</i>&gt;"


@pytest.mark.parametrize("variant", [v for m in LIBRARY.values() for v in m.variants], ids=lambda v: v.name)
def test_no_equation_of_the_library_loses_anything(variant):
    """Without the marks of the page every letter, number and bracket is still there, in order."""
    text = re.sub(r"<[^<>]+>", "", equation(variant.equation))
    names = {letter: name for name, letter in GREEK.items()} | {"−": "-", "′": "'", "µ": "u"}
    back = "".join(names.get(one, one) for one in text)
    kept = [re.sub(r"[\s_^()]", "", one) for one in (back, variant.equation)]
    assert kept[0] == kept[1]
