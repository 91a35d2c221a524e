"""Numbers that could be read in two ways are refused, not guessed; times stay right where rows are dropped."""

from __future__ import annotations

import pytest
from helpers import assert_holds
from hypothesis import given, settings
from hypothesis import strategies as st
from test_csv import make
from test_valid_files import COLUMNS, NUMBERED, convert, table, told, without_time

from mcc_jax._errors import InputError
from mcc_jax.campaign import read_campaign, read_diameters, read_instrument_file

HEAD, CURVE = "particle,D1_um,D2_um,D3_um\n", "particle,time_s,force_mN,displacement_um\nA,0,0,0\nA,1,2,1\n"


def campaign(folder, particles=HEAD + "A,1,2,3\n", curves=CURVE):
    return read_campaign(make(folder / "c", particles, curves))


# ---- a mark that may part thousands or decimals ----------------------------------------------------------------------

LARGE = [("0", "0", "0"), ("1", "500", "1"), ("2", "1.000", "2"), ("3", "1.500", "3")]
IN_MN = [0, 500, 1000, 1500]


def test_a_decimal_mark_between_thousands_is_refused_and_both_ways_out_work(tmp_path):
    text = told(tmp_path, table(rows=LARGE))
    assert_holds(text, ["row 4", "'F'", "'1.000' next to '500'", 'thousands = "point"', 'decimal_mark = ","', '"none"'])
    semicolons = table("t;F;d", rows=LARGE, mark=";")
    keys = 'delimiter = "semicolon"\ndecimal_mark = ","\nthousands = "point"'
    assert convert(tmp_path, semicolons, keys).curves[0].force_mN.tolist() == IN_MN
    meant = convert(tmp_path, table(rows=LARGE), 'thousands = "none"')
    assert meant.curves[0].force_mN.tolist() == [0, 500, 1, 1.5]


@pytest.mark.extended
@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.001, 5000), min_size=3, max_size=8), st.sampled_from(["%.3f", "%.6g", "%g", "%.3e", "%r"]))
def test_what_programs_write_is_never_taken_for_thousands(tmp_path_factory, forces, form):
    folder = tmp_path_factory.getbasetemp() / "plain"
    folder.mkdir(exist_ok=True)
    cells = [form % force for force in [*forces, 0.5]]
    rows = [(str(i), cell, str(i)) for i, cell in enumerate(cells)]
    assert convert(folder, table(rows=rows)).curves[0].force_mN.tolist() == [float(cell) for cell in cells]


@pytest.mark.parametrize("mark", [";", "\t", ","])
def test_thousands_in_a_table_of_particles_are_refused(tmp_path, mark):
    particles = HEAD.replace(",", mark) + mark.join(("A", "980", "1.020", "1.150")) + "\n"
    with pytest.raises(InputError, match=r"row 2, column 'D2_um': '1.020' next to '980'.*Write numbers without marks"):
        campaign(tmp_path, particles)


def test_one_diameter_in_another_unit_is_no_mark_between_thousands(tmp_path):
    found = campaign(tmp_path, "particle,D1_um,D2_mm,D3_mm\nA,980,1.020,1.150\n")
    assert found.diameters_um.tolist() == [[980, 1020, 1150]]


def test_a_comma_that_may_be_either_is_refused_with_tabs_and_quotes(tmp_path):
    for row in ("A\t1,000\t1,100\t1,200\n", 'A,"1,000","1,100","1,200"\n'):
        head = HEAD.replace(",", "\t") if "\t" in row else HEAD
        with pytest.raises(InputError, match=r"'1,000' is not a number"):
            campaign(tmp_path, head + row)


def test_quoted_decimal_commas_in_a_campaign(tmp_path):
    curves = 'particle,time_s,force_mN,displacement_um\nA,"0,0","0,0","0,0"\nA,"1,5","2,25","1,125"\n'
    found = campaign(tmp_path, HEAD + 'A,"213,5","196,1","186,375"\n', curves)
    assert found.diameters_um.tolist() == [[213.5, 196.1, 186.375]]
    assert found.curves[0].force_mN.tolist() == [0, 2.25]


# ---- several tests in a file -----------------------------------------------------------------------------------------


def test_rows_above_every_test_without_a_header(tmp_path):
    text = "Specimen 1\n0,0,0\n1,2,0.5\n\nSpecimen 2\n0,0,0\n1,3,0.5\n"
    found = convert(tmp_path, text, 'skip_rows = 1\nheader_rows = 0\ntests = "blank line"', NUMBERED)
    assert [curve.force_mN.tolist() for curve in found.curves] == [[0, 2], [0, 3]]
    damaged = text.replace("Specimen 2\n0,0,0", "Specimen 2\n0,x,0")  # a row with a number is a sample
    assert "'x' is not a number" in told(
        tmp_path, damaged.replace("Specimen 2\n", ""), 'skip_rows = 1\nheader_rows = 0\ntests = "blank line"', NUMBERED
    )


def test_diameters_above_every_test_without_a_header(tmp_path):
    text = "Diameter 0.2 mm\n0,0,0\n1,2,0.5\n\nDiameter 0.3 mm\n0,0,0\n1,3,0.5\n"
    columns = NUMBERED + '[diameters]\nheader = "Diameter"\n'
    found = convert(tmp_path, text, 'skip_rows = 1\nheader_rows = 0\ntests = "blank line"\n', columns, None)
    assert found.diameters_um.tolist() == [[200] * 3, [300] * 3]


@pytest.mark.parametrize("between", ["\n", "t,F,d\n", ""])
def test_time_that_goes_back_in_a_file_of_one_test(tmp_path, between):
    text = told(tmp_path, table() + between + "0,0,0\n1,2,0.5\n")
    assert "the time of test 'e' goes back" in text
    assert 'write tests = "header", "blank line" or "column"' in text


def test_a_footer_behind_tests_parted_by_blank_lines_names_the_keys(tmp_path):
    text = table() + "\n0,0,0\n1,2,0.5\n\nMaximum,5,1.25\nMean,1,1\n"
    assert "end or skip_footer" in told(tmp_path, text, 'tests = "blank line"')
    for key in ('end = "Maximum"', "skip_footer = 2"):
        assert len(convert(tmp_path, text, f'tests = "blank line"\n{key}')) == 2


# ---- times, dates, names ---------------------------------------------------------------------------------------------


def test_an_interval_counts_rows_whose_reading_is_missing(tmp_path):
    text = "F,d\nNaN,0\n0,0\nNaN,0.5\n2,1\n# a remark\n\n1,0.5\n"
    found = convert(
        tmp_path, text, 'missing = ["NaN"]\ncomment_prefix = "#"', without_time('{ interval = 0.5, unit = "s" }')
    )
    assert found.curves[0].time_s.tolist() == [0.5, 1.5, 2.0]


@pytest.mark.parametrize("cell", ["2026-01-31 10:00:01", "10:00:01", "00:00:01.5"])
def test_dates_and_times_of_day_say_how_to_write_them(tmp_path, cell):
    assert 'unit = "day"' in told(tmp_path, table(rows=[("0", "0", "0"), (cell, "2", "1")]))


def test_a_table_may_write_a_files_ending_in_small_or_capital_letters(tmp_path):
    sizes = tmp_path / "sizes.csv"
    for ending in ("txt", "TXT"):
        sizes.write_text(f"file,D1_um,D2_um,D3_um\ne.{ending},1,2,3\n")
        convert(tmp_path, table())
        found = read_instrument_file(
            tmp_path / "e.txt", mapping=tmp_path / "m.toml", diameters_um=read_diameters(sizes)
        )
        assert found.diameters_um.tolist() == [[1, 2, 3]]


# ---- a folder with files of two kinds --------------------------------------------------------------------------------

GERMAN = 'delimiter = "semicolon"\ndecimal_mark = ","\n'


def two_kinds(folder, first="", second=GERMAN, german="t;F;d\n0;0;0\n1;2,5;0,5\n"):
    (folder / "in").mkdir(exist_ok=True)
    (folder / "in" / "1.txt").write_text("t,F,d\n0,0,0\n1,2.5,0.5\n")
    (folder / "in" / "2.txt").write_text(german)
    mappings = [folder / "first.toml", folder / "second.toml"]
    for file, keys in zip(mappings, (first, second), strict=True):
        file.write_text(keys + COLUMNS)
    return read_instrument_file(folder / "in", mapping=mappings, diameters_um=[3.0, 2.0, 1.0])


def test_each_file_of_a_folder_is_read_by_the_mapping_that_fits(tmp_path):
    found = two_kinds(tmp_path)
    assert [curve.force_mN.tolist() for curve in found.curves] == [[0, 2.5]] * 2
    assert "mapped by first.toml and mapped by second.toml" in (found.metadata.provenance or "")


def test_two_mappings_that_read_one_file_differently_are_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"1\.txt: first\.toml and second\.toml both fit this file and read it differently"
    ):
        two_kinds(tmp_path, second='control = "load"\n')
    assert len(two_kinds(tmp_path, second="", german="t,F,d\n0,0,0\n1,2.5,0.5\n1,3,0.5\n")) == 2  # the same twice


def test_no_mapping_that_fits_and_diameters_in_one_of_two(tmp_path):
    with pytest.raises(InputError, match=r"2\.txt.*by first\.toml, and no other mapping file fits.*--leave-out 2\.txt"):
        two_kinds(tmp_path, german="x|y\n")
    with pytest.raises(InputError, match=r"second\.toml, column 'diameters_um'.*Give --diameters"):
        two_kinds(tmp_path, second=GERMAN + "diameters_um.all = [1, 2, 3]\n")
