"""Whatever the files hold, reading gives a campaign or an `InputError`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_csv import CURVES, make

from mcc_jax._errors import InputError
from mcc_jax.campaign import Campaign, read_campaign

PIECES = st.sampled_from(
    [",", "\n", "\r", '"', '""', ";", "\t", " ", "\0", "nan", "inf", "-", ".", "e", "1e400", "A", "01", "\ufeff", "µ",
     "_", "'", "force_mN", "time_s", "particle", "0x1", "1_0", "１", "True", "\x1a", "\u2028", "\x0b"]
)  # fmt: skip


def outcome(folder) -> Campaign | str:
    try:
        campaign = read_campaign(folder)
    except InputError as error:
        text = str(error)
        assert text.isprintable()
        assert text.startswith(str(folder))
        return text
    for curve in campaign.curves:
        for values in (curve.time_s, curve.force_mN, curve.displacement_um):
            assert len(values) >= 2
            assert np.isfinite(values).all()
        assert (np.diff(curve.time_s) >= 0).all()
    assert (campaign.diameters_um > 0).all()
    return campaign


@st.composite
def mutated(draw, text: str) -> str:
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        length = draw(st.sampled_from([0, 1, 1, 2, 8]))
        text = text[:at] + draw(st.one_of(PIECES, st.text(max_size=2), st.just(""))) + text[at + length :]
    return text


@pytest.mark.extended
@settings(max_examples=400, deadline=None)
@given(curves=mutated(CURVES))
def test_mutated_curves(tmp_path_factory, curves):
    folder = make(tmp_path_factory.getbasetemp() / "curves", curves=curves.encode("utf-8", "surrogatepass"))
    outcome(folder)


@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=200) | st.lists(PIECES, max_size=40).map(lambda p: "".join(p).encode()))
def test_anything_at_all(tmp_path_factory, data):
    folder = make(tmp_path_factory.getbasetemp() / "any", curves=data)
    outcome(folder)
    outcome(make(folder, particles=data, curves=CURVES))
