"""What fuzzing found in the readers, each with the damage that showed it: one line that says what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import refusal

from mcc_jax.calibrate import read_priors
from mcc_jax.campaign import read_diameters, read_instrument_file

SAMPLES = Path(__file__).parent / "samples"
SIZES = [200.0, 190.0, 180.0]


INSTRUMENTS = {
    "peak with two points": ("fischer.txt", b"HM  0.020000/", b"HM  0.02.000/", None),
    "digits of a count": ("fischer.txt", b"\r\n2\tn\t", b"\r\n" + b"2" * 5000 + b"\tn\t", None),
    "digits of points": ("hysitron.hld", b"Test Data Points: 12", b"Test Data Points: " + b"1" * 5000, "neither"),
    "block twice": ("hysitron.hld", b"Sample Approach Data", b"Drift Measurement Data", "appears twice"),
    "hld column twice": ("hysitron.hld", b"\tDisp_V", b"\tDisp_nm", "'Disp_nm': column appears 2 times"),
    "lc digits": ("hysitron_lc.txt", b"Points = 12", b"Points = " + b"1" * 5000, "the format is not known"),
    "lc column twice": ("hysitron_lc.txt", b"\tDepth (V)", b"\tTime (s)", "'Time (s)': column appears 2 times"),
}


@pytest.mark.parametrize("case", INSTRUMENTS)
def test_instruments_files(tmp_path, case):
    name, old, new, words = INSTRUMENTS[case]
    data = (SAMPLES / name).read_bytes()
    assert old in data
    file = tmp_path / name
    file.write_bytes(data.replace(old, new, 1))
    if words is None:  # what cannot be understood of the header is no reason to refuse whole tests
        assert len(read_instrument_file(file, diameters_um=SIZES)) == 2
    else:
        assert words in refusal(read_instrument_file, file, diameters_um=SIZES)


def test_many_empty_lines_behind_the_samples(tmp_path):
    """They were taken off one by one, each time with a copy of all others, which took minutes."""
    file = tmp_path / "a.txt"
    file.write_bytes((SAMPLES / "micromaterials.txt").read_bytes() + b"\n" * 300_000)
    assert len(read_instrument_file(file, diameters_um=SIZES).curves[0]) == 12


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[a]\nmean = 0x" + "f" * 5000, "64 bits"),
        ("[a]\nmean = 1" + "0" * 400, "64 bits"),
        ("[a]\nmean = [[9223372036854775808]]", "64 bits"),
        ("[a]\nmean = -9223372036854775808", None),
        ("\ufeff[a]\nmean = 1", None),
    ],
    ids=["hexadecimal", "decimal", "in lists", "the least", "byte order mark"],
)
def test_toml(tmp_path, text, words):
    (tmp_path / "p.toml").write_text(text, encoding="utf-8")
    if words is None:
        assert read_priors(tmp_path / "p.toml").a.mean in (1.0, -(2.0**63))
    else:
        assert words in refusal(read_priors, tmp_path / "p.toml")


def test_three_long_numbers_are_no_file():
    assert "too large" in refusal(read_diameters, f"1,2,{'9' * 300}")
    assert "not a number" in refusal(read_diameters, f"1,2,{'x' * 300}")
