"""Tables as text, as programs and people write them: read by what is in them.

Encodings with a byte order mark (UTF-8, UTF-16), comments (# or %), a line of titles; cells apart
by commas, semicolons, tabs or spaces, quoted or not; decimal commas where a comma separates
nothing; a separator behind the last cell.
"""

import codecs
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam._runtime.files import LARGEST

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
          (codecs.BOM_UTF16_BE, "utf-16"))  # fmt: skip
_DATES = tuple(
    re.compile(rf"(?<![\d.]){date}(?P<h>\d\d)([:-]?)(?P<m>\d\d)\{back}(?P<s>\d\d)(?!\d)")
    for back, date in (
        (6, r"(?P<year>\d{4})([-/._])(?P<month>\d\d)\2(?P<day>\d\d)[T _]"),
        (5, r"(?P<year>\d{4})(?P<month>\d\d)(?P<day>\d\d)T"),
        (6, r"(?P<day>\d\d)([-.])(?P<month>[A-Z][a-z]{2}|\d\d)\2(?P<year>\d{4})[T _]"),
    )
)
"""Dates and times, which are a cell, in whatever columns: the year first, or the day."""
_MONTHS = "JanFebMarAprMayJunJulAugSepOctNovDec"
_ISO = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:")
_OTHER_DATE = re.compile(r"(?<![\d:])(\d\d?/\d\d?/\d{4}|\d\d?:\d\d:\d\d)")
_TITLED = "write a table with titles instead, as t,x,y,z,qx,qy,qz,qw, a pose per line"
_OTHERS = {
    r"[{[]": ("JSON", _TITLED),
    r"---$|(- )?[A-Za-z_]\w*:( -?[\d.]+)?$": ("YAML", f"{_TITLED} (ros2 topic echo --csv does)"),
    r"\$[A-Z]{4,6},": ("NMEA", "write latitude, longitude and altitude under titles, or a .pos"),
    r"<": ("XML", _TITLED),
}
"""The first lines of files that are no tables: what they are, and what to write instead."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


class Table(NamedTuple):
    """Numbers as text: what its comments say, its rows and the lines that they stand on."""

    path: Path
    comments: tuple[str, ...]
    titles: tuple[str, ...]
    """The names of the columns; none where no line names as many as there are."""
    rows: Float[np.ndarray, "n k"]
    """NaN where a cell is empty, `nan`, or in a column of `words`."""
    lines: tuple[int, ...]
    words: dict[int, tuple[str, ...]]
    """The cells of the columns whose first is no number."""
    separator: str | None = None
    """What is between the cells; None of spaces."""

    def place(self, row: int | np.integer) -> str:
        """Name a row by file and line."""
        return f"{self.path}, line {self.lines[row]}"

    def check(self, wrong: ArrayLike, expected: str) -> None:
        """Raise ValueError for the first row that is wrong, with what is expected there."""
        for row in np.flatnonzero(wrong)[:1]:
            raise ValueError(f"{self.place(row)}: expected {expected}")

    def numbers(
        self, expected: str, columns: Sequence[int] = (), *, spare: bool = True, none: bool = False
    ) -> Float[np.ndarray, "n m"]:
        """Columns of finite numbers up to `LARGEST`, by default all, and maybe `spare` ones; where
        `none` is allowed, rows may be NaN but for the first number.

        `expected` is said in the ValueError for others.
        """
        count = self.rows.shape[1]
        columns = columns or range(count)
        if max(columns) >= count or not (spare or len(columns) == count):
            raise ValueError(f"{self.place(0)}: expected {expected}")
        found = self.rows[:, columns]
        without = none & without_values(found)
        finite = np.isfinite(found[:, 0]) & (without | np.isfinite(found).all(axis=1))
        self.check(~finite, expected)
        self.check((np.abs(found) > LARGEST).any(axis=1), f"numbers up to {LARGEST:.0e}")
        return found


def without_values(rows: Float[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
    """A mask of the rows that have a time and NaN."""
    return np.asarray(np.isnan(rows[:, 1:]).all(axis=1))


def text_lines(path: str | Path, what: str = "file", *, comments: bool = False) -> dict[int, str]:
    """The lines of a text file that are not empty, by their numbers, from 1; with the `comments`
    (#), or without. Raises ValueError for a file, called `what`, that is no text."""
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot read the {what} ({error.strerror})") from None
    if content[:2] in (b"\x1f\x8b", b"PK", b"BZ", b"\xfd7"):
        raise ValueError(f"{path}: is compressed; unpack it first")
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8")
    try:
        lines = content.decode(encoding).splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: cannot be read as text") from None
    return {
        number: line.strip()
        for number, line in enumerate(lines, start=1)
        if line.strip() and (comments or not _is_comment(line))
    }


def read_table(path: str | Path, what: str, holds: str, row: str) -> Table:
    """Read a file of lines with as many cells each, but for empty lines and comments.

    Raises `ValueError`, naming the file and the line: it is a `what` that holds `holds`, and a
    `row` of it is what is accepted.
    """
    return table_of(path, text_lines(path, what, comments=True), holds, row)


def table_of(path: str | Path, told: Mapping[int, str], holds: str, row: str) -> Table:
    """The same of the lines of a file."""
    for mark, (kind, instead) in _OTHERS.items():
        if re.match(mark, next(iter(told.values()), "")):
            raise ValueError(f"{path}: is {kind}, which is not read; {instead}")
    comments = [line.lstrip("#%").strip() for line in told.values() if _is_comment(line)]
    lines = {n: with_iso(line) for n, line in told.items() if not _is_comment(line)}
    named = []
    while lines and not any(_number(cell) is not None for cell in cells(lines[min(lines)])):
        named.append(lines.pop(min(lines)))
    if not lines:
        raise ValueError(f"{path} has no {holds}; expected lines of {row}")
    first = lines[min(lines)]
    if other := _OTHER_DATE.search(_ISO.sub("", first)):
        raise ValueError(
            f"{path}, line {min(lines)}: {other[0]} may mean several times; write seconds, or "
            "dates with times as 2026-11-30T12:00:00"
        )
    separator = _separator(first)
    count = len(cells(first, separator))
    titles = _titles([*reversed(named), *reversed(comments)], count, separator)
    # A last cell may be empty, if there is a title for it.
    last = len(titles) - count if titles else 0
    rows, words = [], {}
    for number, line in lines.items():
        found = cells(line, separator, len(titles))
        if len(found) != count + last:
            raise ValueError(f"{path}, line {number}: expected {row}")
        if not rows:
            words = {i: [] for i, x in enumerate(found) if x and _number(x) is None}
        for i, column in words.items():
            column.append(found[i])
            found[i] = ""
        rows.append([_number(cell) if cell else math.nan for cell in found])
        if None in rows[-1]:
            raise ValueError(f"{path}, line {number}: expected {row}")
    index = int(titles[:1] == ("",))  # a first column without a title, as of pandas
    by_column = {i - index: tuple(column) for i, column in words.items()}
    values = np.array(rows)[:, index:]
    above, places = (*comments, *named), tuple(lines)
    return Table(Path(path), above, titles[index:], values, places, by_column, separator)


def cells(line: str, separator: str | None = "?", titles: int = 0) -> list[str]:
    """The cells of a line, of the separator that is seen in it, or of this; None are spaces.

    A separator behind the last cell is none, but where there are as many `titles`.
    """
    if separator == "?":
        separator = _separator(line)
    if separator != ",":
        line = line.replace(",", ".") if _has_decimal_commas(line, separator) else line
        line = line.replace(",", " ") if separator is None else line
    found = line.split(separator)
    if separator == ",":  # and spaces, as people mix them
        found = [part for cell in found for part in (cell.split() or [""])]
    found = [cell.strip().strip("\"'").strip() for cell in found]
    return found[:-1] if len(found) > 1 and not found[-1] and len(found) != titles else found


def _separator(line: str) -> str | None:
    for separator in (";", "\t"):
        if separator in line:
            return separator
    return None if "," not in line or _has_decimal_commas(line, None) else ","


def _has_decimal_commas(line: str, separator: str | None) -> bool:
    found = [cell for cell in line.split(separator) if "," in cell]
    whole = all(_DECIMAL_COMMA.fullmatch(cell.strip().strip("\"'")) for cell in found)
    # Two numbers in a cell of a line of one cell are two cells.
    return bool(found) and whole and len(line.split(separator)) > 1


def _titles(lines: Sequence[str], count: int, separator: str | None) -> tuple[str, ...]:
    """The nearest line above the numbers that names each column."""
    for line in lines:
        for own in (separator, _separator(line), None):
            found = line.split(own)
            if len(found) in (count, count + 1) and (len(found) == count or own):
                titles = [cell.strip().strip("\"'").strip() for cell in found]
                if len(titles) > count and not titles[-1]:
                    titles.pop()
                if len(titles) > count and titles[0]:
                    continue
                return tuple(titles)
    return ()


def numbers(told: Sequence[str], count: int) -> list[float] | None:
    """Read words as `count` finite numbers up to `LARGEST`; None if they are not."""
    found = [x for word in told if (x := _number(word)) is not None and abs(x) <= LARGEST]
    return found if len(found) == len(told) == count else None


def numbers_of(told: object) -> list[float]:
    """The numbers of a word, or of a list of any depth; none of anything else."""
    if isinstance(told, str):
        words = re.sub(r"[][,]", " ", told).split()
        return numbers(words, len(words)) or []
    try:
        return np.asarray(told, float).ravel().tolist() if told is not None else []
    except (ValueError, TypeError, OverflowError):
        return []


def _number(cell: str) -> float | None:
    """A number, or the seconds from 1970 to a date, of UTC where it says no zone."""
    try:
        if not _ISO.match(cell):
            return float(cell)
        date = datetime.fromisoformat(cell)
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def with_iso(line: str) -> str:
    """A line whose dates are those of ISO 8601."""

    def iso(found: re.Match[str]) -> str:
        year, month, *others = found.group("year", "month", "day", "h", "m", "s")
        month = f"{_MONTHS.find(month) // 3 + 1:02}" if month.isalpha() else month
        return "{}-{}-{}T{}:{}:{}".format(year, month, *others)

    for date in _DATES:
        line = date.sub(iso, line)
    return line


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def vector_of(told: object, count: int) -> Float[np.ndarray, " count"] | None:
    """The numbers of one list of so many; None of anything else."""
    try:
        found = np.asarray(told, float)
    except (ValueError, TypeError, OverflowError):
        return None
    return found if found.shape == (count,) else None
