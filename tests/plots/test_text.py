"""Names of any text are drawn as they stand, short, and stay apart."""

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mcc_jax.campaign import Metadata
from mcc_jax.plots.style import particle_labels, plain


def drawn(text):
    """What matplotlib makes of a text, which raises for bad mathematics."""
    figure = Figure(figsize=(3, 1))
    figure.text(0, 0, text)
    FigureCanvasAgg(figure).draw()


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("$x_1$ <script>", r"\$x_1\$ <script>"),
        ("a_b^c", "a_b^c"),
        ("tab\tnew\nline", "tab new line"),
        ("abcdefghijklmnopqrstuvwxyz", "abcdefghijkl…pqrstuvwxyz"),
        ("µ-Ä", "µ-Ä"),
        ("中", "\N{REPLACEMENT CHARACTER}"),
        ("\x00\x1b", ""),
    ],
)
def test_plain(name, label):
    assert plain(name) == label


@settings(max_examples=30, deadline=None)
@given(st.text(alphabet=st.one_of(st.sampled_from("$\\_^{}%&# "), st.characters()), max_size=40))
def test_any_name_can_be_drawn(name):
    label = plain(name)
    assert len(label.replace("\\$", "$")) <= 24
    drawn(label)
    drawn(f"{label}\n$\\eta_p$ = 1.24")


def test_labels_are_told_apart():
    assert particle_labels(["3", "x", "中", ""]) == ["particle 3", "x", "\N{REPLACEMENT CHARACTER} (no. 3)", "(no. 4)"]
    long = ["the same beginning, 1 of the same end", "the same beginning, 2 of the same end"]
    assert len(set(particle_labels(long))) == 2
    assert len(set(particle_labels(["a b", "a\tb", "a  b"]))) == 3


def test_simulated():
    assert Metadata(provenance="drawn from a table; not a measurement").simulated
    assert Metadata(other={"simulation": {"seed": 1}}).simulated
    assert not Metadata(provenance="file x.txt of tester y").simulated
