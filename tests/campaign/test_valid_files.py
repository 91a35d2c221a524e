"""Files as vendors and spreadsheets write them: read as they are meant, or refused with the key that helps."""

from __future__ import annotations

import csv
import io
import unicodedata
from itertools import pairwise

import numpy as np
import pytest
from helpers import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from test_csv import make

from mcc_jax._errors import InputError
from mcc_jax.campaign import Campaign, read_campaign, read_diameters, read_instrument_file

COLUMNS = """
[columns]
time = { column = "t", unit = "s" }
force = { column = "F", unit = "mN" }
displacement = { column = "d", unit = "um" }
"""
NUMBERED = COLUMNS.replace('"t"', "1").replace('"F"', "2").replace('"d"', "3")
ROWS = [("0", "0", "0"), ("1", "2", "0.5"), ("2", "5", "1.25"), ("3", "1", "0.75")]
FORCES, DISPLACEMENTS = [0, 2, 5, 1], [0, 0.5, 1.25, 0.75]


def table(head: str = "t,F,d", end: str = "", rows=ROWS, mark: str = ",") -> str:
    return "\n".join([head, *(mark.join(row) + end for row in rows)]) + "\n"


def convert(folder, text: str | bytes, keys: str = "", columns: str = COLUMNS, sizes=(200.0, 190.0, 180.0)) -> Campaign:
    (folder / "e.txt").write_bytes(text.encode() if isinstance(text, str) else text)
    (folder / "m.toml").write_text(keys + columns, encoding="utf-8")
    return read_instrument_file(
        folder / "e.txt", mapping=folder / "m.toml", diameters_um=None if sizes is None else list(sizes)
    )


def told(folder, *args, **kwargs) -> str:
    return refusal(convert, folder, *args, **kwargs)


def assert_read(campaign: Campaign, tests: int = 1) -> None:
    assert len(campaign) == tests
    for curve in campaign.curves:
        assert curve.force_mN.tolist() == FORCES
        assert curve.displacement_um.tolist() == DISPLACEMENTS
        assert curve.time_s.tolist() == [0, 1, 2, 3]


# ---- delimiters that part nothing ------------------------------------------------------------------------------------


def test_trailing_delimiters_on_some_rows_and_without_header(tmp_path):
    lines = table().splitlines()
    lines[2] += ",,"
    assert_read(convert(tmp_path, "\n".join(lines)))
    assert_read(convert(tmp_path, "\n".join(line + "," for line in lines[1:]), "header_rows = 0", NUMBERED))


PARTICLES = "particle,D1_um,D2_um,D3_um\nA,200,190,180\nB,150,140,130\n"
CURVES = "particle,time_s,force_mN,displacement_um\n" + "".join(
    f"{name},{t},{f},{d}\n" for name in "AB" for t, f, d in ROWS
)


def campaign_of(folder, particles: str = PARTICLES, curves: str = CURVES) -> Campaign:
    return read_campaign(make(folder, particles, curves))


@pytest.mark.parametrize("end", [",", ",,,", ", ,"])
@pytest.mark.parametrize("file", ["particles", "curves"])
@pytest.mark.parametrize("where", ["rows", "header", "both"])
def test_trailing_delimiters_in_a_campaign(tmp_path, file, where, end):
    head, *rows = {"particles": PARTICLES, "curves": CURVES}[file].splitlines()
    head += end if where != "rows" else ""
    rows = [row + (end if where != "header" else "") for row in rows]
    campaign = campaign_of(tmp_path, **{file: "\n".join([head, *rows]) + "\n"})
    assert_read(campaign, 2)
    assert campaign.diameters_um.tolist() == [[200, 190, 180], [150, 140, 130]]
    assert campaign.columns == {}


@pytest.mark.parametrize("empty", [",,,", " , ,,", '"","",,', ",,,,,", ""])
@pytest.mark.parametrize("place", [1, 3, 99])
def test_rows_of_delimiters_only(tmp_path, empty, place):
    def spoil(text: str) -> str:
        lines = text.splitlines()
        return "\n".join([*lines[:place], empty, empty, *lines[place:]]) + "\n"

    assert_read(campaign_of(tmp_path, spoil(PARTICLES), spoil(CURVES)), 2)
    assert_read(convert(tmp_path, spoil(table())))


# ---- semicolons and tabs in tables of a campaign ---------------------------------------------------------------------


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("comma", [True, False])
def test_tables_with_semicolons_and_tabs(tmp_path, mark, comma):
    def as_saved(text: str) -> str:
        text = text.replace(",", mark)
        return text.replace(".", ",") if comma else text

    particles = PARTICLES.replace("190", "190.25").replace("particle,D1", "particle,note,D1")
    particles = particles.replace("A,", "A,x,").replace("B,", "B,y,")
    campaign = campaign_of(tmp_path, as_saved(particles), as_saved(CURVES))
    assert_read(campaign, 2)
    assert campaign.diameters_um.tolist() == [[200, 190.25, 180], [150, 140, 130]]
    assert campaign.columns == {"note": ("x", "y")}
    found = read_diameters(tmp_path / "particles.csv")
    assert found == {"A": [200, 190.25, 180], "B": [150, 140, 130]}


def test_a_thousands_mark_in_a_german_table_is_not_taken_for_a_decimal_point(tmp_path):
    with pytest.raises(InputError, match=r"row 3, column 'D2_um': '1\.140' is not a number"):
        campaign_of(tmp_path, PARTICLES.replace(",", ";").replace("190", "190,5").replace("140", "1.140"))


# ---- names in two Unicode forms --------------------------------------------------------------------------------------

COMPOSED, APART = "Probe é", unicodedata.normalize("NFD", "Probe é")


def test_names_in_two_unicode_forms_are_one(tmp_path):
    assert COMPOSED != APART
    campaign = campaign_of(tmp_path, PARTICLES.replace("A", COMPOSED), CURVES.replace("A", APART))
    assert campaign.particles == (COMPOSED, "B")
    assert_read(campaign, 2)
    lines = CURVES.replace("A", APART).splitlines()
    mixed = "\n".join([*lines[:3], *(line.replace(APART, COMPOSED) for line in lines[3:])])
    assert_read(campaign_of(tmp_path, PARTICLES.replace("A", COMPOSED), mixed), 2)


def test_columns_tests_and_diameters_in_two_unicode_forms(tmp_path):
    text = table("t,Längé,d").replace("é", unicodedata.normalize("NFD", "é"))
    keys = f'test_name = "{APART}"'
    columns = COLUMNS.replace('"F"', '"Längé"') + f'[diameters_um]\n"{COMPOSED}" = [3.0, 2.0, 1.0]\n'
    campaign = convert(tmp_path, text, keys, columns, None)
    assert campaign.particles == (COMPOSED,)
    assert campaign.diameters_um.tolist() == [[3, 2, 1]]


# ---- numbers ---------------------------------------------------------------------------------------------------------

SPACES = {"blank": " ", "no-break": "\u00a0", "narrow": "\u202f", "thin": "\u2009"}
THOUSANDS = {"point": ".", "comma": ",", "apostrophe": "'", **SPACES}


@pytest.mark.parametrize("name", THOUSANDS)
def test_thousands(tmp_path, name):
    mark, word = THOUSANDS[name], "space" if name in SPACES else name
    decimal = "," if mark == "." else "."
    rows = [("0", "1", "0"), ("1", f"1{mark}234{decimal}5", "1"), ("2", f"-1{mark}234{mark}567", "2")]
    text = table("t;F;d", rows=rows, mark=";")
    keys = f'delimiter = "semicolon"\ndecimal_mark = "{decimal}"\n'
    found = convert(tmp_path, text, f'{keys}thousands = "{word}"')
    assert found.curves[0].force_mN.tolist() == [1, 1234.5, -1234567]
    assert f'thousands = "{word}"' in told(tmp_path, text, keys)


def test_thousands_quoted_and_never_guessed(tmp_path):
    text = table().replace("5,1.25", '"1,000.0",1.25')
    assert convert(tmp_path, text, 'thousands = "comma"').curves[0].force_mN.tolist() == [0, 2, 1000, 1]
    assert 'thousands = "comma"' in told(tmp_path, text)
    ambiguous = told(tmp_path, text.replace("1,000.0", "1,000"))
    assert 'thousands = "comma" (or decimal_mark = ",")' in ambiguous
    assert "groups of three" in told(tmp_path, text.replace("1,000.0", "1,00.0"), 'thousands = "comma"')


def test_quoted_decimal_commas(tmp_path):
    quoted = [tuple(f'"{cell.replace(".", ",")}"' for cell in row) for row in ROWS]
    bare = table(rows=[*quoted[:2], ("2", "5", "1,25"), quoted[3]])
    text = told(tmp_path, bare, 'decimal_mark = ","')
    assert "row 4: 4 cells where 3" in text
    assert "quote" in text


WRITTEN = st.lists(
    st.tuples(*[st.integers(-(10**9), 10**9).map(lambda i: i / 1000)] * 2).filter(lambda pair: pair[0] != 0 != pair[1]),
    min_size=2,
    max_size=6,
)


def as_text(number: float, decimal: str, thousands: str) -> str:
    whole, _, rest = f"{number:,.3f}".partition(".")
    return whole.replace(",", thousands) + decimal + rest


@settings(max_examples=200, deadline=None)
@given(
    numbers=WRITTEN,
    delimiter=st.sampled_from([",", ";", "\t", "|", " "]),
    decimal=st.sampled_from([".", ","]),
    thousands=st.sampled_from(["", ".", ",", "'", "\u2019", *SPACES.values()]),
    quoting=st.sampled_from([csv.QUOTE_ALL, csv.QUOTE_MINIMAL]),
    trailing=st.tuples(*[st.integers(0, 3)] * 2),
    empty=st.integers(0, 7),
)
def test_any_way_of_writing_reads_the_same_numbers(
    tmp_path_factory, numbers, delimiter, decimal, thousands, quoting, trailing, empty
):
    if thousands == decimal or (
        delimiter == " " and (quoting == csv.QUOTE_ALL or any(trailing) or thousands in SPACES.values())
    ):
        return
    out = io.StringIO()
    writer = csv.writer(out, delimiter=delimiter, quoting=quoting)
    writer.writerow(["t", "F", "d", *[""] * trailing[0]])
    for i, pair in enumerate(numbers):
        if i == empty:
            out.write(delimiter * 4 + "\n")
        writer.writerow([str(i), *(as_text(number, decimal, thousands) for number in pair), *[""] * trailing[1]])
    names = {"\t": "tab", " ": "space"}
    keys = f'delimiter = "{names.get(delimiter, delimiter)}"\ndecimal_mark = "{decimal}"\n'
    keys += f'thousands = "{thousands}"\n' if thousands else ""
    curve = convert(tmp_path_factory.mktemp("w"), out.getvalue(), keys).curves[0]
    assert list(zip(curve.force_mN.tolist(), curve.displacement_um.tolist(), strict=True)) == numbers


# ---- missing readings ------------------------------------------------------------------------------------------------

NO_READING = ["NaN", "", "----", "1.79769313486232E+308", "n/a", "-999.0"]


@pytest.mark.parametrize("mark", NO_READING)
@pytest.mark.parametrize("column", [1, 2])
def test_missing_readings(tmp_path, mark, column):
    gap = ["2.5", "3", "1"]
    gap[column] = mark
    text = table(rows=[*ROWS[:3], tuple(gap), ROWS[3]])
    campaign = convert(tmp_path, text, 'missing = ["NaN", "", "----", "1.79769313486232E+308", "N/A", -999]')
    assert_read(campaign)
    (finding,) = campaign.metadata.other["conversion"]["findings"]
    assert finding["sentence"] == "1 row with a missing reading was dropped, in 1 test"
    assert "1 row with a missing reading" in (campaign.metadata.provenance or "")
    if mark != "-999.0":
        text = told(tmp_path, text)
        assert "row 5" in text
        assert f'missing = ["{mark}"]' in text


def test_every_reading_missing(tmp_path):
    text = table(rows=[("1", "-", "2"), ("2", "-", "3")])
    assert "every row has a missing reading" in told(tmp_path, text, 'missing = ["-"]')


def test_the_number_nan_of_a_mapping_and_comments_of_delimiters(tmp_path):
    text = "; a remark\n" + table(rows=[*ROWS, ("4", "nan", "1")], mark=";").replace("t,F,d", "t;F;d")
    assert_read(convert(tmp_path, text, 'delimiter = ";"\ncomment_prefix = ";"\nskip_rows = 1\nmissing = [nan]'))
    body = text.partition("\n")[2].replace("2;5", "; two\n2;5")
    assert_read(convert(tmp_path, body, 'delimiter = ";"\ncomment_prefix = ";"\nmissing = [nan]'))


# ---- above and below the samples -------------------------------------------------------------------------------------

FOOTERS = [
    "Maximum,5,1.25\nMean,2,0.625\n",
    "Maximum;5\nMean\n",
    '"Maximum",,1\n,,\nMean,1,1\n',
    "Maximum,5,1.25,x,y,z\nMean,2\n",
]


@pytest.mark.parametrize("footer", FOOTERS)
def test_footers(tmp_path, footer):
    assert_read(convert(tmp_path, table() + footer, 'end = "Maximum"'))
    assert_read(convert(tmp_path, table() + footer + "\n\n", "skip_footer = 2"))
    text = told(tmp_path, table() + footer)
    assert "row 6" in text
    assert "end or skip_footer" in text


def test_footers_below_every_test(tmp_path):
    block = table() + "Maximum,5,1.25\nMean,1,1\n\n"
    assert_read(convert(tmp_path, block * 3, 'tests = "blank line"\nend = "Maximum"'), 3)


HEADED = "Specimen {}\nt,F,d\n(s),(mN),(um)\n" + table().partition("\n")[2]


@pytest.mark.parametrize("between", ["", "\n", "\n\n,,,\n"])
@pytest.mark.parametrize("tests", ["header", "blank line"])
def test_headers_before_every_test(tmp_path, tests, between):
    if tests == "blank line" and not between:
        return
    text = between.join(HEADED.format(i) for i in (1, 2, 3))
    assert_read(convert(tmp_path, text, f'tests = "{tests}"\nskip_rows = 1\nheader_rows = 2\n'), 3)
    longer = text.replace("Specimen 2", "Specimen 2\nremark, 7\n\nfurther remark")
    assert_read(convert(tmp_path, longer, f'tests = "{tests}"\nbegin = "t"\nheader_rows = 2\n'), 3)


def test_a_header_above_the_first_test_only(tmp_path):
    text = "\n".join(["Tester\n" + table(), *[table().partition("\n")[2]] * 2])
    assert_read(convert(tmp_path, text, 'tests = "blank line"\nskip_rows = 1'), 3)


def test_headers_again_by_names_in_a_column(tmp_path):
    columns = COLUMNS + 'test = { column = "s" }\n'
    text = "".join(table("t,F,d,s", f",{name}") for name in "ab")
    assert_read(convert(tmp_path, text, 'tests = "column"', columns), 2)


def test_headers_that_differ_are_told(tmp_path):
    other = table("t,d,F")
    assert "skip_rows, header_rows or begin" in told(tmp_path, table() + "\n" + other, 'tests = "blank line"')
    text = told(tmp_path, table() + "\n" + other, 'tests = "blank line"\nbegin = "t"')
    assert "without 'F' as its column 2" in text
    assert "no row begins with 'x'" in told(tmp_path, table(), 'begin = "x"')
    assert "correct delimiter" in told(tmp_path, table("t;F;d", mark=";"))


# ---- diameters -------------------------------------------------------------------------------------------------------


SPHERE = COLUMNS + '[diameters]\nheader = "Gage length"\n'


@pytest.mark.parametrize(
    ("row", "extra"),
    [
        ('"Gage length ",0.2,"mm"', ""),
        ("Gage length: 0.2 mm,,", ""),
        ("Gage length [mm],2e-1", ""),
        ("Gage length,200", 'unit = "um"'),
        ("Gage length = ,2.0E-001,,mm", ""),
    ],
)
def test_diameter_from_a_row_above_the_samples(tmp_path, row, extra):
    campaign = convert(tmp_path, f"Operator,N\n{row}\n" + table(), "skip_rows = 2", SPHERE + extra, None)
    assert campaign.diameters_um.tolist() == [pytest.approx([200, 200, 200], rel=1e-14)]


def test_diameters_of_three_axes_before_every_test(tmp_path):
    columns = COLUMNS + '[diameters]\nheader = ["D1", "D2", "D3"]\n'
    text = "".join(f"D1: 0.{i} mm\nD2,{i * 100},um\nD3,1e-{i},m\n" + table() for i in (1, 2))
    campaign = convert(tmp_path, text, 'skip_rows = 3\ntests = "header"', columns, None)
    assert campaign.diameters_um.tolist() == [pytest.approx([100, 100, 1e5]), pytest.approx([200, 200, 1e4])]


@pytest.mark.parametrize(
    ("row", "piece"),
    [
        ("Gage length,0.2", "unit is missing"),
        ("Gage length,0.2,N", "no unit of length"),
        ("Gage length,,mm", "holds no number"),
        ("Gage length,0,mm", "not positive"),
        ("Gage length,-,mm", "not positive"),
        ("Gage length,1,2,mm", "2 numbers"),
        ("Gauge,0.2,mm", "no row above the samples begins with 'Gage length'"),
    ],
)
def test_diameter_that_is_not_told(tmp_path, row, piece):
    assert piece in told(tmp_path, row + "\n" + table(), 'skip_rows = 1\nmissing = ["-"]\n', SPHERE, None)
    assert_read(convert(tmp_path, row + "\n" + table(), "skip_rows = 1", SPHERE))


# ---- files without a column of time ----------------------------------------------------------------------------------


def without_time(pace: str) -> str:
    return COLUMNS.replace('{ column = "t", unit = "s" }', pace)


def test_time_from_an_interval(tmp_path):
    campaign = convert(tmp_path, table(), "", without_time('{ interval = 250, unit = "ms" }'))
    assert campaign.curves[0].time_s.tolist() == [0, 0.25, 0.5, 0.75]
    text = told(tmp_path, table() * 2, "", without_time('{ interval = 250, unit = "ms" }'))
    assert 'tests = "header"' in text


def test_time_from_a_speed(tmp_path):
    campaign = convert(tmp_path, table(), "", without_time('{ speed = 0.03, unit = "mm/min" }'))
    # Up 1.25 um and down 0.5 um at half a micrometre a second.
    assert campaign.curves[0].time_s.tolist() == pytest.approx([0, 1, 2.5, 3.5])


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), cycles=st.integers(1, 4), noise=st.floats(0, 2e-3))
def test_noise_of_the_displacement_adds_no_time(seed, cycles, noise):
    from mcc_jax.campaign.readers.mapping import Pace

    rng = np.random.default_rng(seed)
    corners = np.ravel([[rng.uniform(0, 0.3), rng.uniform(0.7, 1)] for _ in range(cycles)])
    true = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(corners)])
    measured = true + rng.uniform(-noise, noise, len(true))
    times = Pace(speed_um_per_s=0.5).times(measured, np.arange(len(true)))
    path = np.concatenate([[0], np.cumsum(np.abs(np.diff(true)))]) / 0.5
    assert (np.diff(times) >= 0).all()
    assert np.abs(times - path).max() <= 4 * noise * len(corners) / 0.5 + 1e-12


@pytest.mark.parametrize("pace", ['{ speed = 1e-15, unit = "nm/year" }', '{ interval = 1e15, unit = "year" }'])
def test_a_pace_that_cannot_be(tmp_path, pace):
    assert "too large to be real" in told(tmp_path, table(), "", without_time(pace))
