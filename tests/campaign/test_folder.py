"""A folder of instruments' files as one campaign, and Excel workbooks among them."""

from __future__ import annotations

import os
import sys

import pytest
from books import write_book
from helpers import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from test_readers import zipped
from test_valid_files import COLUMNS as MAPPING

from mcc_jax._errors import InputError
from mcc_jax.campaign import Campaign, read_campaign, read_diameters, read_instrument_file, write_campaign
from mcc_jax.campaign.readers.folder import natural, passed_over

SIZES = [200.0, 190.0, 180.0]


def rows_of(scale: float) -> list[list[float]]:
    return [[0.0, 0.0, 0.0], [1.0, 2.5 * scale, 0.1], [2.0, 1e-05, 0.05]]


def text_of(scale: float, preamble: str = "") -> str:
    return preamble + "t,F,d\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows_of(scale))


def folder_of(tmp_path, files: dict[str, str | bytes]):
    folder = tmp_path / "Série 7"
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path / "m.toml").write_text(MAPPING)
    return folder


def read(folder, keys: str = "", **settings) -> Campaign:
    mapping = folder.parent / "m.toml"
    mapping.write_text(keys + MAPPING if "[columns]" not in keys else keys)
    return read_instrument_file(folder, mapping=mapping, **{"diameters_um": SIZES} | settings)


def told(folder, *args, **settings) -> str:
    return refusal(read, folder, *args, **settings)


def findings(campaign: Campaign) -> list[str]:
    return [finding["sentence"] for finding in campaign.metadata.other.get("conversion", {}).get("findings", ())]


TESTS = {"P10.txt": text_of(10), "P9.txt": text_of(9), "p1.TXT": text_of(1)}
NO_TESTS = {".DS_Store": b"\0\1", "Thumbs.db": b"\0", "README": "read me", "photo.PNG": b"\x89PNG", "~$P9.xlsx": b"x"}


def test_every_file_is_a_test(tmp_path):
    campaign = read(folder_of(tmp_path, TESTS))
    assert campaign.particles == ("p1", "P9", "P10")
    assert [curve.force_mN.max() for curve in campaign.curves] == [2.5, 22.5, 25]
    assert campaign.diameters_um.tolist() == [SIZES] * 3
    assert campaign.metadata.provenance == "folder Série 7, 3 files, mapped by m.toml, read by mcc_jax"
    assert findings(campaign) == []
    write_campaign(campaign, tmp_path / "out")
    assert read_campaign(tmp_path / "out").particles == campaign.particles


def test_what_is_no_test_is_passed_over_and_counted(tmp_path):
    folder = folder_of(tmp_path, TESTS | NO_TESTS)
    (folder / "old").mkdir()
    campaign = read(folder)
    assert len(campaign) == 3
    first, second = findings(campaign)
    assert first.startswith("5 files ignored because of the name")
    assert ".DS_Store" in first
    assert second == "1 folder in it not entered: old"
    assert first in (campaign.metadata.provenance or "")
    write_campaign(campaign, tmp_path / "out")
    assert findings(read_campaign(tmp_path / "out")) == [first, second]


@pytest.mark.parametrize("name", ["a.txt", "a", "a.dat", "a.xlsx", "a.csv", "reading.txt", "a.001", "unread me.txt"])
def test_other_files_are_never_passed_over(name):
    assert not passed_over(name)


def test_a_file_that_cannot_be_read_is_named_with_the_way_to_leave_it_out(tmp_path):
    folder = folder_of(tmp_path, TESTS | {"P 2.txt": text_of(2).replace("0.1", "x"), "notes.txt": "Friday"})
    text = told(folder)
    assert "notes.txt, row 1" in text
    assert "2 of 5 files cannot be read" in text
    assert text.endswith("--leave-out notes.txt --leave-out 'P 2.txt'")
    for skip in (["notes.txt", "P 2.txt"], ["notes", "P 2"], ["no*", "P ?.txt"]):
        campaign = read(folder, skip=skip)
        assert campaign.particles == ("p1", "P9", "P10")
        assert findings(campaign) == ["2 files skipped as asked: notes.txt, P 2.txt"]
    assert "--leave-out Notes fits no file" in told(folder, skip=["Notes"])
    assert "there is no instrument file" in told(folder, skip=["*"])
    (tmp_path / "bad").mkdir()
    assert "2 of 2 files cannot be read" in told(folder_of(tmp_path / "bad", {"a.txt": "x", "b.txt": "y"}))


def test_names_that_no_file_can_hold(tmp_path):
    folder = folder_of(tmp_path, TESTS)
    try:
        (folder / os.fsdecode(b"P\xff.txt")).write_text(text_of(1))
    except OSError:
        pytest.skip("this file system has names in Unicode only")
    assert "no Unicode text" in told(folder)
    assert len(read(folder, skip=["P?.txt"])) == 2
    (folder / "P\n5").write_text(text_of(5))
    assert findings(read(folder, skip=["P?.txt", "P\n5"]))[0].isprintable()


def test_names_must_differ(tmp_path):
    text = told(folder_of(tmp_path, TESTS | {"P9.csv": text_of(2)}))
    assert "P9.csv both give a test the name 'P9'" in text or "P9.txt both give a test the name 'P9'" in text
    assert "--leave-out P9." in text


def test_the_same_bytes_twice_are_told(tmp_path):
    campaign = read(folder_of(tmp_path, TESTS | {"P11.txt": text_of(9)}))
    assert len(campaign) == 4
    (finding,) = campaign.metadata.other["conversion"]["findings"]
    assert finding["check"] == "duplicates"
    assert finding["level"] == "warning"
    assert "P9.txt, P11.txt hold the same bytes" in finding["sentence"]
    assert finding["remedy"].endswith("--leave-out P11.txt")


def test_several_tests_in_a_file(tmp_path):
    folder = folder_of(tmp_path, {"a2.txt": text_of(1) + "\n" + text_of(2), "a10.txt": text_of(3)})
    sizes = {"a2-2": [3.0, 2.0, 1.0], "a2": [6.0, 5.0, 4.0], "a10.txt": [9.0, 8.0, 7.0], "other": SIZES}
    campaign = read(folder, 'tests = "header"\n', diameters_um=sizes)
    assert campaign.particles == ("a2-1", "a2-2", "a10")
    assert campaign.diameters_um.tolist() == [[6, 5, 4], [3, 2, 1], [9, 8, 7]]
    assert findings(campaign) == ["1 row of the diameters is for no test here and not used"]


def test_names_of_a_column_find_their_diameters(tmp_path):
    def named(name: str) -> str:
        return "".join(line + f",{'s' if i == 0 else name}\n" for i, line in enumerate(text_of(1).splitlines()))

    folder = folder_of(tmp_path, {"1.txt": named("A"), "2.txt": named("B")})
    keys = 'tests = "column"\n' + MAPPING + 'test = { column = "s" }\n'
    campaign = read(folder, keys, diameters_um={"A": SIZES, "B": [3.0, 2.0, 1.0]})
    assert campaign.diameters_um.tolist() == [SIZES, [3, 2, 1]]


def test_diameters_of_the_files_and_of_a_table(tmp_path):
    files = {f"{i}.txt": text_of(i, f"Gage length,0.{i},mm\n") for i in (1, 2)} | {
        "3.txt": text_of(3, "Gage length,,mm\n")
    }
    folder = folder_of(tmp_path, files)
    keys = "skip_rows = 1\n" + MAPPING + '[diameters]\nheader = "Gage length"\n'
    text = told(folder, keys, diameters_um=None)
    assert "3.txt, row 1: 'Gage length' holds no number" in text
    assert "--leave-out 3.txt" in text
    assert "--diameters" in text
    assert len(read(folder, keys, diameters_um=None, skip=["3"])) == 2
    sizes = {"3.txt": SIZES}
    found = read(folder, keys, diameters_um=sizes).diameters_um.tolist()
    assert found == [pytest.approx([100] * 3), pytest.approx([200] * 3), SIZES]


def test_folders_that_are_none_of_instruments(tmp_path):
    folder = folder_of(tmp_path, TESTS)
    (tmp_path / "nest" / "Série 7").mkdir(parents=True)
    assert "one of the folders in it: Série 7" in told(tmp_path / "nest")
    write_campaign(read(folder), tmp_path / "out")
    assert "is a campaign already" in told(tmp_path / "out")
    assert "test_name" in told(folder, 'test_name = "A"\n')
    with pytest.raises(InputError, match="nothing to skip"):
        read_instrument_file(folder / "P9.txt", mapping=tmp_path / "m.toml", diameters_um=SIZES, skip=["x"])


@settings(max_examples=100, deadline=None)
@given(st.lists(st.text(max_size=8), max_size=6))
def test_natural_order(names):
    backwards = list(reversed(names))
    assert sorted(names, key=natural) == sorted(backwards, key=natural)
    numbers = [f"a{i} b" for i in (100, 2, 11, 1, 10)]
    numbers.sort(key=natural)
    assert numbers == ["a1 b", "a2 b", "a10 b", "a11 b", "a100 b"]


# ---- known formats in folders ----------------------------------------------------------------------------------------

MICRO = "".join(f"{t / 10:.6f}\t{t * 12.5:.6f}\t{t * 0.75:.6f}\r\n" for t in range(8))
LOAD_CONTROL = "Monday\r\n\r\nNumber of Points = 3\r\n\r\n"
LOAD_CONTROL += "Depth (nm)\tLoad (µN)\tTime (s)\r\n0\t0\t0\r\n10\t5\t1\r\n\r\n20\t15\t2\r\n"
HLD = (
    "File Version: Hysitron X\r\nMachine Comp: 0.5 nm/µN\r\nSample Approach Data Points: 70\r\nTime_s\tDisp_nm\r\n"
    + "".join(f"{i}\t{i}\r\n" for i in range(70))
    + "Test Data Points: 2\r\nTime_s\tDisp_nm\tForce_µN\r\n0\t1\t2\r\n1\t2\t3000\r\n"
)


def fischer(count: int) -> str:
    block = "Block : 1   Value : {}\r\nresults\r\nF\th\tt\r\n0,0\t0,0\t0,0\r\n1,5\t0,2\t1,0\r\n\r\n"
    return "".join(block.format(i) for i in range(1, count + 1))


@pytest.mark.parametrize(
    ("content", "peak", "form"),
    [
        (MICRO, 5.25, "Micro Materials text"),
        (LOAD_CONTROL, 0.015, "Hysitron load-control text"),
        (HLD, 3, "Hysitron hld"),
        (fischer(1), 1.5, "Fischer HM export"),
    ],
)
def test_a_folder_of_each_known_format(tmp_path, content, peak, form):
    folder = folder_of(tmp_path, {f"{i}.dat": content.encode("latin-1") + b"\r\n" * i for i in (2, 10, 1)})
    campaign = read_instrument_file(folder, diameters_um={"1": SIZES, "2.dat": SIZES, "10": SIZES})
    assert campaign.particles == ("1", "2", "10")
    assert [curve.force_mN.max() for curve in campaign.curves] == [pytest.approx(peak)] * 3
    assert form in (campaign.metadata.provenance or "")
    write_campaign(campaign, tmp_path / "out")
    assert (tmp_path / "out" / "campaign.toml").stat().st_size < 2000


def test_archives_and_many_tests_in_a_file(tmp_path):
    folder = folder_of(tmp_path, {"b.txt": fischer(3)})
    (folder / "a.zip").write_bytes(zipped(**{"x.txt": MICRO.encode(), "y.txt": MICRO.encode()}))
    campaign = read_instrument_file(folder, diameters_um=SIZES)
    assert campaign.particles == ("a-x", "a-y", "b-1", "b-2", "b-3")
    assert campaign.metadata.control is None


# ---- Excel workbooks -------------------------------------------------------------------------------------------------

HEAD = ["t", "F", "d"]


def test_everything_unusual_in_a_workbook(tmp_path):
    rows = [
        ["Prüfung", 7],
        [None, "Gage length", 0.25, "mm"],
        [None, "Zeit", "Kraft", "Weg", "Probe"],
        [None, "s", "N", "µm"],
        *[[None, float(t), t / 8, t / 4, 1] for t in range(3)],
        [None, None],
        [None, 3, "----", 0.5, 1],
        [None, 4, "0,5", 1.5, 1],
        [None, "Maximum", 2.5],
    ]
    write_book(tmp_path / "x.xlsx", {"Info": [["Labor"]], "Daten 1": rows})
    mapping = """
sheet = "Daten 1"
begin = "Zeit"
header_rows = 2
decimal_mark = ","
missing = ["----"]
end = "Maximum"
tests = "column"
[columns]
time = { column = "Zeit", unit = "s" }
force = { column = "Kraft", unit = "N" }
displacement = { column = "Weg", unit = "um" }
test = { column = "Probe" }
[diameters]
header = "Gage length"
"""
    (tmp_path / "m.toml").write_text(mapping, encoding="utf-8")
    campaign = read_instrument_file(tmp_path / "x.xlsx", mapping=tmp_path / "m.toml")
    assert campaign.particles == ("1",)
    assert campaign.diameters_um.tolist() == [[250, 250, 250]]
    assert campaign.curves[0].force_mN.tolist() == [0, 125, 250, 500]
    assert findings(campaign) == ["1 row with a missing reading was dropped, in 1 test"]
    (tmp_path / "m.toml").write_text(mapping.replace('"Daten 1"', "2"), encoding="utf-8")
    assert len(read_instrument_file(tmp_path / "x.xlsx", mapping=tmp_path / "m.toml").curves[0]) == 4


@settings(max_examples=40, deadline=None)
@given(
    numbers=st.lists(
        st.tuples(*[st.floats(-1e9, 1e9, allow_subnormal=False).filter(bool)] * 2), min_size=2, max_size=5
    ),
    decimal=st.sampled_from([".", ","]),
    shift=st.integers(0, 3),
)
def test_numbers_of_a_workbook_are_exact(tmp_path_factory, numbers, decimal, shift):
    folder = tmp_path_factory.mktemp("b")
    rows = [[None] * shift + [i, *pair] for i, pair in enumerate(numbers)]
    write_book(folder / "x.xlsx", {"A": [[None] * shift + HEAD, *rows]})
    (folder / "m.toml").write_text(f'decimal_mark = "{decimal}"\ndelimiter = ";"\n' + MAPPING)
    curve = read_instrument_file(folder / "x.xlsx", mapping=folder / "m.toml", diameters_um=SIZES).curves[0]
    assert list(zip(curve.force_mN.tolist(), curve.displacement_um.tolist(), strict=True)) == numbers


def test_a_table_of_diameters_in_a_workbook(tmp_path):
    rows = [["file", "D3_um", "D2_um", "D1_mm", "note"], ["P9.txt", 1, 2.5, 0.3, "x"], [None], [10, 4, 5, 0.6, None]]
    found = read_diameters(write_book(tmp_path / "d.xlsx", {"Tabelle1": rows, "Tabelle2": []}))
    assert found == {"P9.txt": [300, 2.5, 1], "10": [600, 5, 4]}
    write_book(tmp_path / "d.xlsx", {"x": [["junk"]], "particles": rows})
    assert read_diameters(tmp_path / "d.xlsx") == found
    rows[1][2] = "2,5"
    with pytest.raises(InputError, match="row 2, column 'D2_um': '2,5' is not a number"):
        read_diameters(write_book(tmp_path / "d.xlsx", {"Tabelle1": rows}))
    with pytest.raises(
        InputError, match=r"2 sheets hold something: 'x', 'y'\. Call the sheet with the table 'particles'"
    ):
        read_diameters(write_book(tmp_path / "d.xlsx", {"x": rows, "y": rows}))


def book_told(tmp_path, keys: str, sheets, mapping: bool = True) -> str:
    write_book(tmp_path / "x.xlsx", sheets)
    (tmp_path / "m.toml").write_text(keys + MAPPING)
    described = tmp_path / "m.toml" if mapping else None
    return refusal(read_instrument_file, tmp_path / "x.xlsx", mapping=described, diameters_um=SIZES)


def test_workbooks_that_do_not_fit(tmp_path):
    good = [HEAD, *rows_of(1)]
    assert 'Write sheet = "..." in m.toml' in book_told(tmp_path, "", {"a": good, "b": good})
    assert "The sheets are: 'a', 'b'" in book_told(tmp_path, 'sheet = "c"\n', {"a": good, "b": good})
    assert "no sheet 3" in book_told(tmp_path, "sheet = 3\n", {"a": good, "b": good})
    assert "'b' is empty" in book_told(tmp_path, 'sheet = "b"\n', {"a": good, "b": []})
    assert "every sheet is empty" in book_told(tmp_path, "", {"a": []})
    assert "row 3, column 'F': 'x' is not a number" in book_told(tmp_path, "", {"a": [HEAD, good[1], [1, "x", 1]]})
    assert "--mapping" in book_told(tmp_path, "", {"a": good}, mapping=False)
    (tmp_path / "t.txt").write_text(text_of(1))
    (tmp_path / "m.toml").write_text("sheet = 1\n" + MAPPING)
    with pytest.raises(InputError, match="no Excel workbook"):
        read_instrument_file(tmp_path / "t.txt", mapping=tmp_path / "m.toml", diameters_um=SIZES)


def test_without_the_package_for_workbooks(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "python_calamine", None)
    text = book_told(tmp_path, "", {"a": [HEAD, *rows_of(1)]})
    assert "pip install 'mcc-jax[excel]'" in text


@settings(max_examples=60, deadline=None)
@given(at=st.floats(0, 1), byte=st.integers(0, 255), cut=st.booleans())
def test_damaged_workbooks_never_crash(tmp_path_factory, at, byte, cut):
    folder = tmp_path_factory.mktemp("d")
    data = bytearray(write_book(folder / "x.xlsx", {"a": [HEAD, *rows_of(1)]}).read_bytes())
    place = int(at * (len(data) - 1))
    data[place] = byte
    (folder / "x.xlsx").write_bytes(bytes(data[:place] if cut and place else data))
    (folder / "m.toml").write_text(MAPPING)
    try:
        campaign = read_instrument_file(folder / "x.xlsx", mapping=folder / "m.toml", diameters_um=SIZES)
    except InputError:
        return
    assert len(campaign) == 1
