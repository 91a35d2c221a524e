from __future__ import annotations

import pytest
from helpers import INSTRUMENTS, assert_holds, assert_same_curves, refusal
from test_readers import lines_of

from mcc_jax._errors import InputError
from mcc_jax.campaign import read_instrument_file

MAPPING = """
[columns.time]
column = "Time (s)"
unit = "s"
[columns.force]
column = "Load"
unit = "N"
[columns.displacement]
column = "Depth"
unit = "nm"
[diameters_um]
all = [200, 190, 180]
"""
TABLE = "Time (s),Load,Depth\n0,0,0\n1,0.001,500\n2,0.002,1000\n"


def convert(tmp_path, table: str | bytes = TABLE, mapping: str = MAPPING, **kwargs):
    (tmp_path / "t.dat").write_bytes(table.encode() if isinstance(table, str) else table)
    (tmp_path / "m.toml").write_text(mapping, encoding="utf-8")
    return read_instrument_file(tmp_path / "t.dat", mapping=tmp_path / "m.toml", **kwargs)


def message(*args, **kwargs) -> str:
    return refusal(convert, *args, **kwargs)


def test_everything_unusual_at_once(tmp_path):
    table = (
        "Prüfer 7\nirgendwas\nZeit;Kraft;Weg;Probe\nms;mN;µm;-\n% Bemerkung\n"
        "0;-0,5;0;01\n500;-1,5;-0,25;01\n\n0;-1;0;b\n1;-2;-1e-1;b\n"
    )
    mapping = """
encoding = "latin-1"
delimiter = "semicolon"
decimal_mark = ","
comment_prefix = "%"
skip_rows = 2
header_rows = 2
tests = "column"
control = "displacement"
provenance = "Labor 7"
[columns]
time = { column = "Zeit", unit = "ms" }
force = { column = 2, unit = "mN", sign = -1 }
displacement = { column = "Weg", unit = "µm", sign = -1 }
test = { column = "Probe" }
[diameters_um]
01 = [1.0, 2.0, 3.0]
b = [4.0, 5.0, 6.0]
"""
    campaign = convert(tmp_path, table.encode("latin-1"), mapping)
    assert campaign.particles == ("01", "b")
    assert campaign.diameters_um.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert campaign.curves[0].time_s.tolist() == [0, 0.5]
    assert campaign.curves[0].force_mN.tolist() == [0.5, 1.5]
    assert campaign.curves[1].displacement_um.tolist() == [0, 0.1]
    assert campaign.metadata.control == "displacement"
    assert campaign.metadata.other == {"mapping_provenance": "Labor 7"}


def test_blank_lines_part_tests_without_header(tmp_path):
    mapping = """
delimiter = "space"
header_rows = 0
tests = "blank line"
columns.time = { column = 1, unit = "s" }
columns.force = { column = 2, unit = "gf" }
columns.displacement = { column = 3, unit = "um" }
"""
    table = "\n  0 0   0\n1 1 1\n\n\n0 0 0\n 2 3 4\n5 6 7\n\n"
    campaign = convert(tmp_path, table, mapping, diameters_um=[1.0, 1.0, 1.0])
    assert campaign.particles == ("1", "2")
    assert [len(curve) for curve in campaign.curves] == [2, 3]
    assert campaign.curves[0].force_mN[1] == pytest.approx(9.80665)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252", "gb18030"])
def test_encodings(tmp_path, encoding):
    campaign = convert(tmp_path, TABLE.encode(encoding), f'encoding = "{encoding}"\n' + MAPPING)
    assert len(campaign.curves[0]) == 3


def test_fischer_through_a_mapping_equals_its_reader(tmp_path):
    rows = "\n".join(lines_of("FS1.txt")[84:1285])
    mapping = """
encoding = "latin-1"
delimiter = "tab"
decimal_mark = ","
columns.time = { column = "t", unit = "s" }
columns.force = { column = "F", unit = "mN" }
columns.displacement = { column = "h", unit = "um" }
"""
    mapped = convert(tmp_path, rows.encode("latin-1"), mapping, diameters_um=[1.0, 1.0, 1.0])
    known = read_instrument_file(INSTRUMENTS / "FS1.txt", diameters_um=[1.0, 1.0, 1.0])
    assert_same_curves(mapped.curves, known.curves[:1])


def without(table: str) -> str:
    kept, skip = [], False
    for line in MAPPING.splitlines():
        skip = line == f"[{table}]" if line.startswith("[") else skip
        if not skip:
            kept.append(line)
    return "\n".join(kept)


BAD_MAPPING = {
    "not TOML": ("x", ["row 1", "not TOML"]),
    "empty": (" ", ["'columns'", "is missing"]),
    "unknown key": ('delimeter = ","\n' + MAPPING, ["'delimeter'", "Did you mean 'delimiter'?"]),
    "unknown key of columns": (
        MAPPING + "[columns.particle]\ncolumn = 4\n",
        ["'columns.particle'", "Known keys: time"],
    ),
    "no columns": ("skip_rows = 1", ["'columns'", "is missing", "[columns.force]"]),
    "no time": (without("columns.time"), ["'columns.time': is missing"]),
    "no unit": (MAPPING.replace('unit = "N"', ""), ["'columns.force.unit'", "missing", "mN"]),
    "unknown unit": (MAPPING.replace('"N"', '"bananas"'), ["'columns.force.unit'", "unknown"]),
    "sign": (MAPPING.replace('"N"', '"N"\nsign = 2'), ["'columns.force.sign'", "1 or -1"]),
    "column zero": (MAPPING.replace('"Load"', "0"), ["'columns.force.column'"]),
    "name without header": ("header_rows = 0\n" + MAPPING, ["'columns.time.column'", "header_rows"]),
    "test column missing": ('tests = "column"\n' + MAPPING, ["'columns.test'", "needed"]),
    "tests unknown": ('tests = "row"\n' + MAPPING, ["'tests'", '"blank line"']),
    "delimiter long": ('delimiter = "ab"\n' + MAPPING, ["'delimiter'", '"semicolon"']),
    "thousands unknown": ('thousands = "dot"\n' + MAPPING, ["'thousands'", '"apostrophe"']),
    "thousands and decimals": ('thousands = "point"\n' + MAPPING, ["'thousands'", "also the decimal mark"]),
    "thousands and delimiter": ('delimiter = "space"\nthousands = "space"\n' + MAPPING, ["'thousands'", "delimiter"]),
    "begin and rows": ('begin = "T"\nskip_rows = 1\n' + MAPPING, ["'begin'", "Keep one"]),
    "header again, but none": ('tests = "header"\nheader_rows = 0\n' + MAPPING, ["'tests'", "header_rows"]),
    "speed of what": (MAPPING.replace('column = "Time (s)"', "speed = 1"), ["'columns.time.unit'", "mm/s"]),
    "interval in mm": (
        MAPPING.replace('column = "Time (s)"\nunit = "s"', 'interval = 1\nunit = "mm"'),
        ["no unit of time"],
    ),
    "both diameters": (MAPPING + '[diameters]\nheader = "D"\n', ["'diameters'", "Keep one"]),
    "diameters of no row": (without("diameters_um") + "\n[diameters]\n", ["'diameters.header'", "Gage length"]),
    "unit of diameters": (without("diameters_um") + '\n[diameters]\nheader = "D"\nunit = "N"', ["'diameters.unit'"]),
    "name for many": ('tests = "blank line"\ntest_name = "A"\n' + MAPPING, ["'test_name'", "Remove"]),
    "diameters no table": ("diameters_um = 3\n" + without("diameters_um"), ["'diameters_um'", "all = "]),
    "diameters text": (MAPPING.replace("180", '"180"'), ["'diameters_um'", "three numbers"]),
    "diameters huge": (MAPPING.replace("180", "1" + "0" * 400), ["'all'", "64 bits"]),
    "diameters zero": (MAPPING.replace("180", "0"), ["three positive"]),
}


BAD_TABLE = {
    "no such column": (TABLE.replace("Load", "Laod"), "", ["row 1", "no column 'Load'", "Did you mean 'Laod'"]),
    "column twice": (TABLE.replace("Depth", "Load"), "", ["row 1", "2 columns called 'Load'", "number"]),
    "overflow in its unit": (TABLE.replace("0.001", "1e14"), "", ["row 3", "'Load'", "too large"]),
    "cells too few": (TABLE.replace(",500", ""), "", ["row 3", "2 cells where 3"]),
    "time goes back": (TABLE + "1.5,1,1\n", "", ["row 5", "goes back"]),
    "quotes": (TABLE.replace("0.001", '"0.001'), "", ["row 3", "quotes"]),
    "no rows": (TABLE, "skip_rows = 50\n", ["no column"]),
    "header only": ("Time (s),Load,Depth\n", "", ["no rows of data", "m.toml"]),
    "encoding": (TABLE.replace("Load", "L\xf6ad").encode("latin-1"), "", ["cannot be decoded as 'utf-8'"]),
    "encoding unknown": (TABLE, 'encoding = "klingon"\n', ["cannot be decoded as 'klingon'"]),
    "empty": ("", "", ["empty"]),
}


CASES = [("m.toml", TABLE, mapping, pieces) for mapping, pieces in BAD_MAPPING.values()]
CASES += [("t.dat", table, extra + MAPPING, pieces) for table, extra, pieces in BAD_TABLE.values()]


@pytest.mark.parametrize(("file", "table", "mapping", "pieces"), CASES, ids=[*BAD_MAPPING, *BAD_TABLE])
def test_a_bad_mapping_or_table_is_named(tmp_path, file, table, mapping, pieces):
    text = message(tmp_path, table, mapping)
    assert text.startswith(str(tmp_path / file))
    assert_holds(text, pieces)


def test_missing_mapping(tmp_path):
    (tmp_path / "t.dat").write_text(TABLE)
    with pytest.raises(InputError, match="no such file"):
        read_instrument_file(tmp_path / "t.dat", mapping=tmp_path / "m.toml")
