from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_holds, assert_same_curves, refusal
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax._errors import InputError
from mcc_jax.campaign import Campaign, Curve, Metadata, read_campaign, write_campaign

PARTICLES = "particle,D1_um,D2_um,D3_um,batch\nA,200,190,180,x\n01,150,140,130,\n"
CURVES = (
    "particle,time_s,force_mN,displacement_um\n"
    "A,0,0,0\nA,1,2.5,0.1\nA,2,5,0.2\n01,0,0,0\n01,0.5,1,0.05\n01,0.5,2,0.07\n"
)


def make(folder: Path, particles: str | bytes | None = PARTICLES, curves: str | bytes | None = CURVES, toml=None):
    folder.mkdir(exist_ok=True)
    for name, content in (("particles.csv", particles), ("curves.csv", curves), ("campaign.toml", toml)):
        if content is not None:
            (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder


def assert_same(a: Campaign, b: Campaign) -> None:
    assert a.particles == b.particles
    assert np.array_equal(a.diameters_um, b.diameters_um)
    assert a.columns == b.columns
    assert a.metadata == b.metadata
    assert_same_curves(a.curves, b.curves)


def message(folder: Path) -> str:
    return refusal(read_campaign, folder)


def test_reads_plain_campaign(tmp_path):
    campaign = read_campaign(make(tmp_path / "c"))
    assert campaign.particles == ("A", "01")
    assert campaign.diameters_um.tolist() == [[200, 190, 180], [150, 140, 130]]
    assert campaign.columns == {"batch": ("x", "")}
    assert campaign.curves[1].force_mN.tolist() == [0, 1, 2]
    assert campaign.source == str(tmp_path / "c")
    assert campaign.metadata == Metadata()


def test_converts_units(tmp_path):
    curves = "displacement_nm,time_ms,particle,force_N\n1000,0,A,0\n2000,500,A,0.001\n3,1,01,0\n4,2,01,1e-6\n"
    particles = "D3_m,D1_mm,D2_nm,particle\n0.00018,0.2,190000,A\n1e-4,1e-1,1e5,01\n"
    campaign = read_campaign(make(tmp_path / "c", particles, curves))
    assert campaign.diameters_um.tolist() == [[200, 190, 180], [100, 100, 100]]
    assert campaign.curves[0].displacement_um.tolist() == [1, 2]
    assert campaign.curves[0].time_s.tolist() == [0, 0.5]
    assert campaign.curves[0].force_mN.tolist() == [0, 1]
    assert campaign.curves[1].displacement_um.tolist() == [0.003, 0.004]


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("N", 1e3), ("uN", 1e-3), ("µN", 1e-3), ("nN", 1e-6), ("kN", 1e6), ("gf", 9.80665), ("newton", 1e3)],
)
def test_accepts_units_of_force(tmp_path, unit, factor):
    curves = CURVES.replace("force_mN", f"force_{unit}")
    force = read_campaign(make(tmp_path / "c", curves=curves)).curves[0].force_mN
    assert force == pytest.approx([0, 2.5 * factor, 5 * factor], rel=1e-14)


def test_accepts_byte_order_mark_crlf_blanks_and_empty_rows(tmp_path):
    windows = "\ufeff" + CURVES.replace(",force", " , force").replace("\n", "\r\n") + "\r\n\r\n"
    assert_same(read_campaign(make(tmp_path / "a", curves=windows)), read_campaign(make(tmp_path / "b")))


def test_rows_of_particles_may_be_mixed(tmp_path):
    header, *rows = CURVES.splitlines()
    mixed = "\n".join([header, *(rows[i] for i in (3, 0, 4, 1, 5, 2))])
    assert_same(read_campaign(make(tmp_path / "a", curves=mixed)), read_campaign(make(tmp_path / "b")))


def test_metadata(tmp_path):
    toml = (
        'control = "load"\nforce_resolution_uN = 100\npunch_diameter_mm = 0.5\ncorrections = ["frame_compliance"]\n'
        'provenance = "made up"\nlab = "L"\n[tester]\ncompliance_um_per_mN = 0.1\n'
    )
    metadata = read_campaign(make(tmp_path / "c", toml=toml)).metadata
    assert metadata == Metadata(
        "load",
        0.1,
        None,
        500.0,
        "made up",
        ("frame_compliance",),
        {"lab": "L", "tester": {"compliance_um_per_mN": 0.1}},
    )


P, C, T = "particles.csv", "curves.csv", "campaign.toml"
HEAD = "particle,time_s,force_mN,displacement_um\n"
DIAMETERS = "particle,D1_um,D2_um,D3_um\n"

# Which file, its content, and pieces that the message must hold.
BAD = {
    "particles empty": (P, "", ["empty", "Export"]),
    "curves header only": (C, HEAD, ["row 1", "no row of data"]),
    "particle column missing": (
        C,
        CURVES.replace("particle,", "sample,"),
        ["row 1", "'particle' is missing", "Add it"],
    ),
    "diameter missing": (P, "particle,D1_um,D2_um\nA,1,1\n01,1,1\n", ["'D3_um' is missing"]),
    "force misspelt": (C, CURVES.replace("force_mN", "forse_mN"), ["Did you mean 'force_mN' by 'forse_mN'"]),
    "unit missing": (C, CURVES.replace("force_mN", "force"), ["column 'force'", "unit is missing", "force_mN"]),
    "unit unknown": (C, CURVES.replace("force_mN", "force_bananas"), ["'force_bananas'", "unknown", "mN, N, uN"]),
    "unit of other kind": (C, CURVES.replace("force_mN", "force_um"), ["'force_um'", "no unit of force", "mN"]),
    "unit an expression": (C, CURVES.replace("force_mN", "force_N*2"), ["'force_N*2'", "not a unit"]),
    "force twice": (C, "particle,time_s,force_mN,force_N,displacement_um\nA,0,0,0,0\n", ["given 2 times", "Keep one"]),
    "same name twice": (C, "particle,time_s,time_s,force_mN,displacement_um\n", ["'time_s'", "2 times", "Rename"]),
    "name of column empty": (P, PARTICLES.replace("batch", " "), ["5 cells", "header has 4"]),
    "unknown column of curves": (C, HEAD.strip() + ",temp\nA,0,0,0,1\n", ["'temp'", "no column of curves"]),
    "text for a number": (C, CURVES.replace("A,1,2.5", "A,1,abc"), ["row 3", "'force_mN'", "'abc' is not a number"]),
    "decimal comma": (C, CURVES.replace("A,1,2.5", 'A,1,"2,5"'), ["row 3", "'2,5'", "decimal comma", "decimal point"]),
    "decimal comma unquoted": (C, CURVES.replace("A,1,2.5", "A,1,2,5"), ["row 3", "5 cells", "decimal point"]),
    "underscore": (C, CURVES.replace("2.5", "2_5"), ["row 3", "'2_5' is not a number"]),
    "NaN": (C, CURVES.replace("2.5", "nan"), ["row 3", "'force_mN'", "not a finite number"]),
    "empty cell": (C, CURVES.replace("2.5", ""), ["row 3", "'force_mN'", "empty"]),
    "number huge": (C, CURVES.replace("2.5", "1e200"), ["row 3", "'force_mN'", "too large"]),
    "number huge in its unit": (C, CURVES.replace("2.5", "1e14").replace("mN", "N"), ["row 3", "too large", "unit"]),
    "diameter negative": (P, PARTICLES.replace("140", "-140"), ["row 3", "'D2_um'", "not positive"]),
    "diameter tiny": (P, PARTICLES.replace("140", "1e-300"), ["row 3", "'D2_um'", "too small", "unit"]),
    "particle twice": (P, PARTICLES.replace("01,", "A,"), ["row 3", "'A' is already in row 2", "one row"]),
    "particle without curve": (P, PARTICLES + "B,1,1,1,\n", ["row 4", "'B' has no curve", "remove it"]),
    "curve without particle": (C, CURVES + "B,0,0,0\nB,1,1,1\n", ["row 8", "'B' is not in particles.csv", "Add its"]),
    "blank before a name": (P, PARTICLES.replace("\n01", "\n 01"), ["row 3", "' 01' has no curve"]),
    "name empty": (P, PARTICLES.replace("01,", ","), ["row 3", "'particle'", "name is empty"]),
    "time goes back": (C, CURVES.replace("A,2,", "A,0.5,"), ["row 4", "'time_s'", "goes back", "order of time"]),
    "one row": (C, HEAD + "A,0,0,0\nA,1,1,1\n01,0,1,1\n", ["row 4", "'01' has one row only", "two rows"]),
    "too many cells": (C, CURVES.replace("A,2,5,0.2", "A,2,5,0.2,7"), ["row 4", "5 cells", "header has 4"]),
    "quotes open": (C, CURVES.replace("A,2", '"A,2'), ["row 4", "quotes", "Close"]),
    "thousands": (P, PARTICLES.replace("200", '"1,200.5"'), ["row 2", "'D1_um'", "between the thousands"]),
    "Latin-1": (P, PARTICLES.replace("A,", "\xb5,").encode("latin-1"), ["row 2", "0xb5", "UTF-8"]),
    "Latin-1 behind a mark": (
        P,
        b"\xef\xbb\xbf" + PARTICLES.replace("01,", "\xb5,").encode("latin-1"),
        ["row 3", "0xb5"],
    ),
    "UTF-16": (C, CURVES.encode("utf-16"), ["UTF-16", "UTF-8"]),
    "gzip": (C, b"\x1f\x8b\x08\x00junk", ["gzip", "plain CSV"]),
    "forces all zero": (C, HEAD + "A,0,0,0\nA,1,0,1\n01,0,1,1\n01,1,1,1\n", ["row 2", "'force_mN'", "holds no data"]),
    "TOML broken": (T, 'control = "load"\nx = = 1\n', ["row 2", "not TOML", "double quotes"]),
    "TOML deep": (T, "x = " + "[" * 20_000, ["nested"]),
    "TOML deep in keys": (T, "a." * 2000 + "b = 1", ["nested"]),
    "control unknown": (T, 'control = "force"', ["'control'", "'force'", '"displacement"']),
    "resolution negative": (T, "force_resolution_mN = -1", ["'force_resolution_mN'", "> 0"]),
    "punch huge": (T, "punch_diameter_um = 1" + "0" * 400, ["'punch_diameter_um'", "64 bits"]),
    "punch without unit": (T, "punch_diameter = 500", ["'punch_diameter'", "unit is missing", "punch_diameter_um"]),
    "punch twice": (T, "punch_diameter_um = 500\npunch_diameter_mm = 0.5", ["2 times", "Keep one"]),
    "corrections no list": (T, 'corrections = "creep"', ["'corrections'", "list of names"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_file_is_one_line_with_place_and_remedy(tmp_path, case):
    file, content, pieces = BAD[case]
    folder = make(tmp_path / "c")
    (folder / file).write_bytes(content.encode() if isinstance(content, str) else content)
    text = message(folder)
    assert text.startswith(str(folder / file))
    assert len(text) < 420 + len(str(folder))
    assert_holds(text, pieces)
    # What to do stands behind a full stop.
    assert ". " in text.removeprefix(str(folder / file))


def test_bad_folders(tmp_path):
    assert "no such folder" in message(tmp_path / "none")
    folder = make(tmp_path / "c")
    assert "is a file" in message(folder / "curves.csv")
    (folder / "curves.csv").rename(folder / "Curves.CSV")
    assert "curves.csv is missing" in message(folder)
    assert "found: Curves.CSV, particles.csv" in message(folder)
    for name in ("campaign.toml.txt", "Campaign.toml"):  # as editors and systems write it
        other = make(tmp_path / name)
        (other / name).write_text("protocol = 'x'")
        assert f"{name} would not be read" in message(other)
    (tmp_path / "empty").mkdir()
    assert "found: nothing" in message(tmp_path / "empty")
    (folder / "curves.csv").mkdir()
    assert "folder where a file is expected" in message(folder)


def test_unreadable_file(tmp_path, monkeypatch):
    folder = make(tmp_path / "c")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    text = message(folder)
    assert "particles.csv: cannot be read: Permission denied" in text
    assert "Check the permissions" in text


def test_row_counts_lines_within_quotes_and_empty_lines(tmp_path):
    particles = DIAMETERS + '"A\nB",1,1,1\n'
    curves = HEAD + '"A\nB",0,0,0\n\n"A\nB",1,x,0\n'
    assert "row 5, column 'force_mN'" in message(make(tmp_path / "c", particles, curves))


NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=12).filter(
    str.strip
)
NASTY = st.sampled_from(
    ["01", "1", "1.0", "NA", "null", "nan", "None", "True", "a,b", 'say "so"', " lead", "trail ", "ü µ 粒子", "a\nb",
     "a\r\nb", "a\rb", "'", "-", "1e5", "#", "=1+1", "\ufeffx", "x\x85y", "\u2028z", "a;b", "\t tab"]
)  # fmt: skip
VALUES = st.floats(-1e15, 1e15, allow_nan=False)
LENGTHS = st.floats(1e-6, 1e15)


@st.composite
def campaign_parts(draw):
    # The run-time type checks draw random numbers, which Hypothesis forbids in here; the test puts it together.
    names = draw(st.lists(st.one_of(NAMES, NASTY), min_size=1, max_size=4, unique=True))
    curves = []
    for _ in names:
        n = draw(st.integers(2, 6))
        time = np.sort(draw(st.lists(VALUES, min_size=n, max_size=n)))
        force, displacement = (np.array(draw(st.lists(VALUES, min_size=n, max_size=n).filter(any))) for _ in range(2))
        curves.append((time, force, displacement))
    columns = {
        name: tuple(draw(st.one_of(NASTY, st.just(""))) for _ in names)
        for name in draw(st.lists(NASTY.map(str.strip), max_size=2, unique=True))
        if "\ufeff" not in name
    }
    leaves = st.one_of(
        st.text(st.characters(exclude_categories=["Cs"])), st.integers(-(2**63), 2**63), st.booleans(),
        st.floats(allow_nan=False), st.just(datetime.date(2020, 2, 29)), st.datetimes(), st.times(),
    )  # fmt: skip
    trees = st.recursive(
        leaves, lambda t: st.lists(t, max_size=3) | st.dictionaries(st.text(max_size=3), t, max_size=3)
    )
    other = draw(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"]), max_size=5), trees, max_size=3))
    metadata = {
        "control": draw(st.sampled_from([None, "load", "displacement"])),
        "punch_diameter_um": draw(st.none() | st.floats(1e-3, 1e9)),
        "provenance": draw(st.none() | NASTY),
        "corrections": tuple(draw(st.lists(NASTY, max_size=2))),
        "other": other,
    }
    diameters = np.array([[draw(LENGTHS) for _ in range(3)] for _ in names])
    return tuple(names), diameters, curves, columns, metadata


@settings(max_examples=120, deadline=None)
@given(parts=campaign_parts())
def test_round_trip_is_exact(tmp_path_factory, parts):
    names, diameters, curves, columns, metadata = parts
    campaign = Campaign(names, diameters, tuple(Curve(*c) for c in curves), columns, Metadata(**metadata))
    folder = tmp_path_factory.mktemp("round") / "c"
    refused = None
    try:
        write_campaign(campaign, folder)
    except InputError as error:
        refused = str(error)
    if refused is None:
        assert_same(read_campaign(folder), campaign)
        return
    # Only what TOML cannot hold, or would read as something else, is refused, and with nothing written.
    assert "Metadata.other" in refused or "Keep text, numbers" in refused
    assert not folder.exists()


LINE = Curve([0, 1], [0, 1], [0, 1])


def simple(**changes) -> Campaign:
    parts = {"particles": ("A",), "diameters_um": np.full((1, 3), 100.0), "curves": (LINE,)}
    return Campaign(**parts | changes)


@pytest.mark.parametrize(
    ("changes", "piece"),
    [
        ({"particles": (), "diameters_um": np.empty((0, 3)), "curves": ()}, "no particle"),
        ({"particles": ("A", "A"), "diameters_um": np.ones((2, 3)), "curves": (LINE, LINE)}, "appears 2 times"),
        ({"diameters_um": np.full((1, 3), np.nan)}, "not all positive"),
        ({"particles": ("\0",)}, "NUL"),
        ({"particles": ("\ud800",)}, "Unicode"),
        ({"particles": ("  ",)}, "empty"),
        ({"curves": (Curve([0, 1], [0, np.nan], [1, 1]),)}, "force of test 'A' is nan"),
        ({"curves": (Curve([1, 0], [1, 1], [1, 1]),)}, "goes back.*sample 2"),
        ({"curves": (Curve([0], [1], [1]),)}, "one row only"),
        ({"curves": (Curve([0, 0], [0, 0], [1, 1]),)}, "every force"),
        ({"columns": {"D1_um": ("x",)}}, "name of a further column"),
        ({"metadata": Metadata(other={"control": 1})}, "cannot be a further key"),
        ({"metadata": Metadata(other={"x": None})}, "no form in TOML"),
        ({"metadata": Metadata(other={"force_resolution_N": 1})}, "would not read back"),
    ],
)
def test_unfit_campaign_is_not_written(tmp_path, changes, piece):
    with pytest.raises(InputError, match=piece):
        write_campaign(simple(**changes), tmp_path / "c")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "piece"),
    [
        ({"particles": ("A", "B")}, r"shape \(1, 3\) where \(2, 3\)"),
        (
            {"particles": "AB", "diameters_um": np.ones((2, 3)), "curves": (LINE, LINE)},
            "list of texts, got the text 'AB'",
        ),
        ({"diameters_um": np.full((1, 2), 1.0)}, "shape"),
        ({"diameters_um": [["a", "b", "c"]]}, "D1, D2, D3"),
        ({"curves": ()}, "particles has 1 entries and curves has 0"),
        ({"columns": {"x": ("x", "y")}}, "particles has 1 entries and the column 'x' has 2"),
    ],
)
def test_what_is_no_campaign_cannot_be_made(changes, piece):
    with pytest.raises(InputError, match=piece):
        simple(**changes)


def test_a_campaign_takes_lists_and_series():
    import pandas as pd

    table = pd.DataFrame({"t": [0, 1, 2], "F": [0.0, 10.0, 20.0], "d": [0.0, 3.0, 5.0]}, index=[7, 8, 9])
    curve = Curve(table["t"], table["F"], table["d"])
    campaign = Campaign(["x"], [[200, 190, 180]], [curve], {"batch": pd.Series([3])})
    assert campaign.particles == ("x",)
    assert campaign.columns == {"batch": ("3",)}
    assert campaign.diameters_um.dtype == float
    for values in (curve.time_s, curve.force_mN, curve.displacement_um):
        assert type(values) is np.ndarray
        assert values.dtype == float
    same = Curve([0, 1, 2], (0.0, 10.0, 20.0), table["d"].to_numpy())
    np.testing.assert_array_equal(same.force_mN, curve.force_mN)


def test_a_curve_of_unequal_lengths_names_both():
    with pytest.raises(InputError, match="time_s has 2 entries and force_mN has 3"):
        Curve(np.zeros(2), np.ones(3), np.ones(2))
    with pytest.raises(InputError, match="1-D"):
        Curve(np.zeros((2, 1)), np.ones(2), np.ones(2))


def test_write_replaces_whole_and_keeps_other_files(tmp_path):
    folder = make(tmp_path / "c", toml='control = "load"')
    (folder / "notes.txt").write_text("mine")
    write_campaign(simple(), folder)
    assert_same(read_campaign(folder), simple())
    assert sorted(p.name for p in folder.iterdir()) == ["campaign.toml", "curves.csv", "notes.txt", "particles.csv"]
    assert [p.name for p in tmp_path.iterdir()] == ["c"]
