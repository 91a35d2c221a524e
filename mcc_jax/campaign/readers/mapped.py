"""Reading a table, of text or of a workbook, as a mapping file describes it."""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path

import numpy as np

from ..._errors import InputError
from ..._format import counted
from .. import tables
from ..schema import Curve, fault_of
from .mapping import MappingFile
from .text import Tests, decode_lines

_FURTHEST = 200  # rows above a header found by `begin`, within which it is sought again; a preamble has a few dozen
_OWN_DIAMETER = "Add it to the file, or give this test's diameters in a table by --diameters"

_Reading = float | None  # NaN where it is marked as missing, None where the cell holds something else


def read_mapped(data: bytes, file: Path, mapping: MappingFile) -> Tests:
    """The tests of a file; `InputError` if it does not hold what the mapping says, or a cell is damaged."""
    reader, name = _Reader(_Rows(data, file, mapping), file, mapping), mapping.file.name
    reader.read()
    if not reader.has_data:
        raise reader.wrong("there are no rows of data", f"Check skip_rows, header_rows, end and skip_footer in {name}")
    for test in reader.missing:
        if test not in reader.samples:
            remedy = f"Check missing in {name}, or remove the test's rows"
            raise reader.wrong(f"every row has a missing reading in the test {test!r}", remedy)
    reader.refuse_groups()
    curves = {test: reader.curve(test) for test in reader.samples}
    other = {"mapping_provenance": mapping.provenance} if mapping.provenance else {}
    return Tests(curves, f"mapped by {name}", mapping.control, other, reader.diameters_um, dict(reader.missing))


class _Rows:
    """Rows of a table, lines of text or the cells of a workbook's sheet; text is split when it is asked for."""

    def __init__(self, data: bytes, file: Path, mapping: MappingFile) -> None:
        self.file, self.mapping, self.delimiter = file, mapping.file.name, mapping.delimiter
        self.nothing = '" \t' if mapping.delimiter == " " else mapping.delimiter + '" \t'
        self.rows: list[str] | list[list[str]]
        if tables.is_workbook(data):
            how = f'Write sheet = "..." in {mapping.file.name}'
            self.rows = tables.read_sheet(data, file, mapping.sheet, decimal_mark=mapping.decimal_mark, how=how)
            return
        if mapping.sheet is not None:
            problem = f"is no Excel workbook (xlsx), though {mapping.file.name} names a sheet"
            raise InputError(problem, file=file, remedy="Remove the key sheet, or save the file as xlsx")
        kind = tables.binary_kind(data)
        if kind is not None and not mapping.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32")):
            remedy = "Unpack it, save it as xlsx or text, or name its encoding"
            raise InputError(f"the file is {kind}", file=file, remedy=remedy)
        first, *others = decode_lines(data, mapping.encoding, file)
        self.rows = [first.removeprefix("\ufeff"), *others]

    def line(self, i: int) -> str:
        row = self.rows[i]
        return row if isinstance(row, str) else "\t".join(row)

    def blank(self, i: int) -> bool:
        """Whether a row holds nothing but delimiters."""
        return not self.line(i).strip(self.nothing)

    def begins(self, i: int, text: str | None) -> bool:
        """Whether a row, or the first thing that it holds, begins with a text, if there is one."""
        if text is None:
            return False
        line, text = tables.same_text(self.line(i).lstrip()), tables.same_text(text)
        return line.startswith(text) or line.lstrip(self.nothing).startswith(text)

    def cells(self, i: int) -> list[str]:
        row = self.rows[i]
        if not isinstance(row, str):
            return row
        if self.delimiter == " ":
            return row.split()
        if '"' not in row:
            return row.split(self.delimiter)
        try:
            return tables.split(row, self.file, self.delimiter)[0][0]
        except InputError as error:
            remedy = f"Close every double quote, or correct delimiter in {self.mapping}"
            raise error.changed(row=i + 1, remedy=remedy) from None


class _Reader:
    """Goes through the rows once and keeps what belongs to each test."""

    def __init__(self, rows: _Rows, file: Path, mapping: MappingFile) -> None:
        self.rows, self.file, self.mapping = rows, file, mapping
        # Of each test the index of a sample's row, its number in the test, and the readings.
        self.samples: dict[str, list[tuple[int, int, list[_Reading]]]] = {}
        self.missing: Counter[str] = Counter()
        self.diameters_um: dict[str, list[float] | InputError] = {}
        self.count = len(rows.rows)
        self.between = False  # whether the next sample begins a test

    def wrong(self, problem: str, remedy: str, i: int | None = None, column: str | int | None = None) -> InputError:
        """The error for the file, or for its row of index `i`."""
        row, named = None if i is None else i + 1, None if column is None else str(column)
        return InputError(problem, file=self.file, row=row, column=named, remedy=remedy)

    @property
    def has_data(self) -> bool:
        """Whether there was a row of data."""
        return bool(self.samples or self.missing)

    def read(self) -> None:
        """Read all rows. Raises `InputError` at the first row that is neither sample, header nor footer."""
        rows, mapping = self.rows, self.mapping
        head = mapping.skip_rows or 0
        if mapping.begin is not None:
            head = next((i for i in range(self.count) if rows.begins(i, mapping.begin)), self.count)
            if head == self.count:
                raise self.wrong(f"no row begins with {mapping.begin!r}", f"Correct begin in {mapping.file.name}")
        i = head + mapping.header_rows
        self.header = rows.cells(head) if mapping.header_rows and head < self.count else None
        full = [i, *(j for j in range(i, self.count) if not rows.blank(j))]
        self.stop = full[max(-mapping.skip_footer, -len(full))] if mapping.skip_footer else self.count
        self.where = {name: self._place(source.column, head) for name, source in mapping.sources.items()}
        self.wanted = [quantity for quantity in tables.DIMENSIONS if quantity in self.where]
        first = self.header
        if first is None:
            first = next((rows.cells(j) for j in range(head, self.stop) if not rows.blank(j)), [])
        needed = max(self.where.values()) + 1
        # The cells that a row must have: without and with what is empty behind the last column.
        self.width, self.raw_width = max(needed, tables.filled(first)), max(needed, len(first))
        sizes = self._diameters(0, head)
        block, ended = 1, False
        while i < self.stop:
            if rows.blank(i):
                self.between = self.between or mapping.tests == "blank line"
                ended = ended and mapping.tests != "blank line"
            elif rows.begins(i, mapping.comment_prefix):
                pass
            elif None in (readings := self._readings(i)) and (below := self._begins_again(i)) is not None:
                top = below - mapping.header_rows
                if self.header is not None and mapping.tests == "file" and mapping.pace is not None:
                    remedy = f'Write tests = "header" in {mapping.file.name}'
                    raise self.wrong("the header comes again, so this is more than one test", remedy, top)
                sizes = self._diameters(i, top) if top > i else sizes
                self.between, ended = self.between or mapping.tests == "header", False
                i = below - 1
            else:
                ended = ended or rows.begins(i, mapping.end)
                if not ended:
                    if mapping.tests in ("blank line", "header"):
                        block += self.between and self.has_data
                    self._take(i, readings, block, sizes)
            i += 1

    def _take(self, i: int, readings: list[_Reading], block: int, sizes: list[float] | InputError | None) -> None:
        """Keep a row of data, of the test of this number where the file does not name it, with its diameters."""
        cells = self.rows.cells(i)
        if len(cells) != self.raw_width and not (len(cells) >= self.width >= tables.filled(cells)):
            count = len(cells) if len(cells) < self.width else tables.filled(cells)
            remedy = "Fill the row or delete it; if the file was cut off here, export it again"
            if count > self.width:
                remedy = f"Check delimiter and decimal_mark in {self.mapping.file.name}, and quote text that holds the "
                remedy += "delimiter, and every number with a decimal comma where commas separate the columns"
            problem = f"{counted(count, 'cell')} where {self.width} are expected"
            raise self.wrong(problem, self._no_sample(cells) or remedy, i)
        missing = any(number != number for number in readings)
        if None in readings and not missing:
            quantity = self.wanted[readings.index(None)]
            try:
                self._number(cells[self.where[quantity]])
            except ValueError as error:
                remedy = self._number_remedy(cells, cells[self.where[quantity]].strip())
                raise self.wrong(str(error), remedy, i, self.mapping.sources[quantity].column) from None
        name = self._name(cells, block, i)
        self.between = False
        if missing:
            self.missing[name] += 1
        else:
            samples = self.samples.setdefault(name, [])
            samples.append((i, len(samples) + self.missing[name], readings))
        if sizes is not None:
            self.diameters_um.setdefault(name, sizes)

    def _place(self, column: str | int, head: int) -> int:
        """The index of a column, by its name in the header or its number."""
        if isinstance(column, int):
            if self.header is not None and column > len(self.header):
                raise self.wrong(f"there is no column {column}, only {len(self.header)}", "Count again", head)
            return column - 1
        names = _names(self.header or [])
        found = [i for i, name in enumerate(names) if name == tables.same_text(column)]
        if len(found) == 1:
            return found[0]
        if found:
            raise self.wrong(f"there are {len(found)} columns called {column!r}", "Give its number", head)
        known = ", ".join(filter(None, names)) or "none"
        keys = f"delimiter, skip_rows or begin in {self.mapping.file.name}"
        remedy = f"There are: {known}; if these are not the names of columns, correct {keys}"
        if close := get_close_matches(column, names, n=1):
            remedy = f"Did you mean {close[0]!r}?"
        raise self.wrong(f"there is no column {column!r}", remedy, head)

    def _begins_again(self, i: int) -> int | None:
        """The index of the row below, if the rows above the first sample, or those like them, come again at a row."""
        rows, mapping = self.rows, self.mapping
        above = (mapping.skip_rows or 0) if mapping.begin is None else _FURTHEST
        if self.header is None and not (self.between and self.has_data):
            return None
        for j in range(i, min(i + above + 1, self.stop)):
            readings = self._readings(j)
            if self.header is None:
                if None not in readings:
                    return j
                if any(number is not None and number == number for number in readings):
                    return None  # a damaged sample
            elif rows.begins(j, mapping.begin) or (mapping.begin is None and rows.cells(j) == self.header):
                names, first = _names(rows.cells(j)), _names(self.header)
                for place in self.where.values():
                    if place >= len(names) or names[place] != first[place]:
                        problem = f"the header comes again without {first[place]!r} as its column {place + 1}"
                        raise self.wrong(problem, "Put tests with other columns into a separate file", j)
                return j + mapping.header_rows
            elif None not in readings:
                return None
        return None

    # ---- cells -------------------------------------------------------------------------------------------------------

    def _readings(self, i: int) -> list[_Reading]:
        """The readings of a row, as numbers without a unit."""
        cells = [] if self.rows.blank(i) else self.rows.cells(i)
        places = [self.where[quantity] for quantity in self.wanted]
        return [self._reading(cells[place]) if place < len(cells) else None for place in places]

    def _reading(self, cell: str) -> _Reading:
        texts, numbers = self._missing_marks
        try:
            number = self._number(cell)
        except ValueError:
            number = None
        return math.nan if number in numbers or (texts and cell.strip().lower() in texts) else number

    @cached_property
    def _missing_marks(self) -> tuple[set[str], set[float]]:
        """Texts, and numbers, that mean that there is no reading."""
        texts, numbers = set[str](), set[float]()
        for mark in self.mapping.missing or ():
            texts.add(str(mark).strip().lower())  # TOML has a number nan, which equals nothing, itself included
            with contextlib.suppress(ValueError):
                numbers.add(tables.parse_number(mark) if isinstance(mark, str) else mark)
        return texts, numbers

    def _number(self, cell: str) -> float:
        return tables.parse_number(cell, self.mapping.decimal_mark, self.mapping.thousands or "")

    def _number_remedy(self, cells: list[str], cell: str) -> str:
        """What to do about a cell of a row that is no number, by what it looks like."""
        name, mark = self.mapping.file.name, tables.thousands_mark(cell, self.mapping.decimal_mark)
        if _CLOCK.fullmatch(cell):
            return (
                "Write times as numbers, not as dates or hours and minutes (in a spreadsheet: the cells' number format "
                f'"General", and unit = "day" in {name})'
            )
        if mark is not None and not self.mapping.thousands:
            word = {".": "point", ",": "comma"}.get(mark, "apostrophe" if mark in tables.APOSTROPHES else "space")
            other = ' (or decimal_mark = ",")' if mark == "," and cell.count(",") == 1 and "." not in cell else ""
            return f'If the mark separates thousands, write thousands = "{word}"{other} in {name}'
        if _is_no_reading(cell):
            quoted = cell.replace("\\", "\\\\").replace('"', '\\"')
            return f'Correct the cell, or write missing = ["{quoted}"] in {name} to drop such readings'
        return self._no_sample(cells) or f"Correct the cell, or decimal_mark and unit in {name}"

    def _no_sample(self, cells: list[str]) -> str | None:
        """What to do about a row whose first reading is text, and which so perhaps is none of the samples."""
        place = min(self.where[quantity] for quantity in self.wanted)
        first = cells[place].strip() if place < len(cells) else ""
        if self._reading(first) is not None or _is_no_reading(first):
            return None
        above, below = "skip_rows, header_rows or begin", "end or skip_footer"
        keys = f"{above} (above the samples), or {below} (below them)" if self.has_data else above
        return f"If this row is not a sample, correct {keys} in {self.mapping.file.name}"

    # ---- what a test holds besides its readings ----------------------------------------------------------------------

    def _name(self, cells: list[str], block: int, i: int) -> str:
        match self.mapping.tests:
            case "blank line" | "header":
                return str(block)
            case "column":
                name = tables.same_text(cells[self.where["test"]].strip())
                if not name:
                    column = self.mapping.sources["test"].column
                    raise self.wrong("the test's name is empty", "Fill the cell, or remove the row", i, column)
                return name
            case "file":
                return tables.same_text(self.mapping.test_name or self.file.stem)

    def _diameters(self, start: int, stop: int) -> list[float] | InputError | None:
        """D1, D2, D3 [um] as the rows from `start` to `stop` hold them, or why not: a table may hold them."""
        if (asked := self.mapping.diameters) is None:
            return None
        try:
            found = [self._length(name, asked.unit, start, min(stop, self.count)) for name in asked.names]
        except InputError as error:
            return error
        return found * 3 if len(found) == 1 else found

    def _length(self, name: str, unit: str | None, start: int, stop: int) -> float:
        """The length [um] in the first row that begins with a name; it has this unit, or one of its own."""
        for i in range(start, stop):
            if not self.rows.begins(i, name):
                continue
            rest = tables.same_text(" ".join(cell.strip() for cell in self.rows.cells(i) if cell.strip()))[len(name) :]
            if rest[:1].isalnum():
                continue
            words = rest.replace(":", " ").replace("=", " ").split()
            readings = [self._reading(word) for word in words]
            numbers = [number for number in readings if number is not None]
            units = [word.strip("[]()") for word, number in zip(words, readings, strict=True) if number is None]
            if len(numbers) != 1:
                problem = f"{name!r} holds {len(numbers) or 'no'} number{'s' if numbers else ''}"
                raise self.wrong(problem, _OWN_DIAMETER, i)
            try:
                factor = tables.unit_factor("".join(units[:1]) if unit is None else unit, "length")
            except ValueError as error:
                remedy = f'Write unit = "mm" below header in {self.mapping.file.name}'
                raise self.wrong(str(error), remedy, i, name) from None
            if not numbers[0] > 0:
                raise self.wrong(f"the diameter {numbers[0]:g} is not positive", _OWN_DIAMETER, i, name)
            return float(tables.convert(np.array(numbers), factor)[0])
        raise self.wrong(f"no row above the samples begins with {name!r}, for the diameter", _OWN_DIAMETER)

    # ---- tests -------------------------------------------------------------------------------------------------------

    def refuse_groups(self) -> None:
        """Refuse a column of text whose decimal mark looks like one between thousands, unless the mapping says none."""
        if self.mapping.thousands is not None or not isinstance(self.rows.rows[0], str):
            return
        mark = self.mapping.decimal_mark
        taken = [i for samples in self.samples.values() for i, _, _ in samples]
        for quantity in self.wanted:
            found = tables.thousands_for_decimals([self.rows.cells(i)[self.where[quantity]] for i in taken], mark)
            if found is not None:
                word, other = ("point", ",") if mark == "." else ("comma", ".")
                remedy = (
                    f'Write thousands = "{word}" and decimal_mark = "{other}" in {self.mapping.file.name}, or '
                    'thousands = "none" if it is a decimal mark'
                )
                raise self.wrong(found[1], remedy, taken[found[0]], self.mapping.sources[quantity].column)

    def curve(self, name: str) -> Curve:
        """A test in canonical units."""
        mapping, samples = self.mapping, self.samples[name]
        raw = np.array([readings for _, _, readings in samples], float).T
        columns = {
            quantity: mapping.sources[quantity].sign * tables.convert(values.copy(), mapping.sources[quantity].factor)
            for quantity, values in zip(self.wanted, raw, strict=True)
        }
        if mapping.pace is not None:
            columns["time"] = mapping.pace.times(columns["displacement"], np.array([order for _, order, _ in samples]))
        curve = Curve(columns["time"], columns["force"], columns["displacement"])
        if (fault := fault_of(name, curve)) is not None:
            remedy = fault.remedy
            if fault.channel == "time" and mapping.tests == "file":
                remedy += '; if another test begins here, write tests = "header", "blank line" or "column" in '
                remedy += mapping.file.name
            column = mapping.sources[fault.channel].column if fault.channel in mapping.sources else fault.channel
            raise self.wrong(fault.problem, remedy, samples[fault.reading][0], column or None)
        return curve


_CLOCK = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}.*|(?:[0-9]+ days?,? )?[0-9]{1,2}:[0-9]{2}(?::[0-9.]+)?.*")


def _names(header: list[str]) -> list[str]:
    return [tables.same_text(name).strip() for name in header]


def _is_no_reading(cell: str) -> bool:
    """Whether a cell looks like what instruments write for "no reading": nothing, dashes, NaN, the largest number."""
    if not any(c.isalnum() for c in cell) or cell.lower().strip("+-#") in ("nan", "inf", "na", "n/a", "null", "none"):
        return True
    try:
        return abs(float(cell.replace(",", "."))) > tables.LARGEST_MAGNITUDE
    except ValueError:
        return False
