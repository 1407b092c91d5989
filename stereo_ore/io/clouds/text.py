"""Text clouds: XYZ, ASC, PTS and CSV, separated by commas, semicolons, tabs or blanks, with or
without names.
"""

from __future__ import annotations

import codecs
import logging
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.colours import as_bytes
from stereo_ore.io.clouds.numbers import DECIMAL_COMMA, EXACT, is_number, narrowest, plain
from stereo_ore.io.clouds.records import (
    MOST_POINTS_IN_ROWS,
    Columns,
    Records,
    columns_of,
    from_columns,
    known_names,
    require_xyz,
    unnamed,
    upright,
)

_log = logging.getLogger(__name__)

LONGEST_LINE = 100_000
COMMENT = re.compile(r"\s*(#|//)")


@dataclass(frozen=True)
class _Layout:
    """What the first lines say: the separator, names (None: none), non-blank lines before the
    rows.
    """

    separator: str | None
    names: list[str] | None
    skip: int
    decimal_comma: bool
    width: int
    whole: tuple[bool, ...]


def read(path: Path) -> Records:
    """Rows of numbers; the first three columns are x, y, z unless a line of names says otherwise.

    A first line with as many names as there are columns, x, y and z among them, is the line of
    names also behind a ``#`` or ``//``; a lone number before the rows is their count.
    """
    layout = _layout(path)
    values = _numbers(path, layout)
    if not len(values):
        values = np.empty((0, max(layout.width, 3)))
    if layout.names is None and values.shape[1] < 3:
        raise CloudError(
            f"holds numbers of shape {values.shape}; shape (N, 3 or more) wanted", file=path
        )
    whole = layout.whole
    if layout.names is None and values.shape[1] > MOST_POINTS_IN_ROWS:
        values, whole = upright(values, path), ()
    if layout.names is not None and len(layout.names) != values.shape[1]:
        raise CloudError(f"has {len(layout.names)} names for {values.shape[1]} columns", file=path)
    names = layout.names or _unnamed(values, path)
    names = [name or f"column_{i}" for i, name in enumerate(names)]  # pandas names no index
    if len(set(names)) < len(names):
        raise CloudError("has a column name twice", file=path)
    columns = Columns()
    for i, name in enumerate(names):
        is_whole = i < len(whole) and whole[i] and name not in ("x", "y", "z")
        columns[name] = (
            _integers(path, layout, values[:, i], i) if is_whole else narrowest(values[:, i])
        )
    if all(axis in columns for axis in "xyz") and any(
        columns[axis].dtype == np.float64 for axis in "xyz"
    ):
        columns |= {
            axis: columns[axis].astype(np.float64) for axis in "xyz"
        }  # one type for the three
    return require_xyz(from_columns(as_bytes(columns)), path)


def _unnamed(values: npt.NDArray[np.float64], path: Path) -> list[str]:
    """Names of columns that have none: x, y, z first, or behind one that counts the rows."""
    names = list(unnamed(values[:1]).dtype.names or ())
    counts = len(values) > MOST_POINTS_IN_ROWS and values.shape[1] > 3
    if not (counts and values[0, 0] in (0, 1) and (np.diff(values[:, 0]) == 1).all()):
        return names
    _log.warning("%s: the first column counts the rows; x, y, z are the next three", path)
    return ["index", *names[:3], *(f"column_{i}" for i in range(4, len(names)))]


def _lines(path: Path) -> Iterator[str]:
    """Lines that are not blank."""
    with path.open("rb") as file:
        head = file.read(4)
    encoding = (
        "utf-16" if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    )
    with path.open(encoding=encoding, errors="replace") as file:
        try:
            yield from (line for line in _bounded(file, path) if line.strip())
        except UnicodeError:
            raise CloudError("is no text", file=path) from None


def _bounded(file: TextIO, path: Path) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            problem = f"a line has more than {LONGEST_LINE:,} characters"
            raise CloudError(problem, file=path, remedy="Is it a table of points?")
        yield line


def _layout(path: Path) -> _Layout:
    """What the lines up to the first row say."""
    names: list[str] | None = None
    comments, skip, count = list[str](), 0, None
    for line in _lines(path):
        marked = COMMENT.match(line)
        if marked:
            comments.append(line[marked.end() :].lstrip("/# "))
            skip += 1
            continue
        words, separator, comma = _split(line)
        if names is None and not all(map(is_number, words)):
            names = _names(words, path, line)
            skip += 1
        elif names is None and count is None and len(words) == 1 and words[0].isdigit():
            count, skip = int(words[0]), skip + 1
        else:
            names = names or _commented(comments, len(words), separator)
            whole = tuple(bool(re.fullmatch(r"[+-]?\d{1,19}", word)) for word in words)
            return _Layout(separator, names, skip, comma, len(words), whole)
    return _Layout(None, names, skip, False, len(names or ()), ())


def _split(line: str) -> tuple[list[str], str | None, bool]:
    """Words of a line, the separator, and whether its decimal points are commas."""
    stripped = line.strip()
    blanks = stripped.split()
    if (
        len(blanks) > 1
        and "," in stripped
        and all(DECIMAL_COMMA.fullmatch(w) or is_number(w) for w in blanks)
    ):
        return blanks, None, True
    separator = next((s for s in (";", "\t", ",") if s in stripped), None)
    if separator is None:
        return [word.strip('"') for word in blanks], None, False
    words = [word.strip().strip('"') for word in stripped.rstrip("\r\n").split(separator)]
    while len(words) > 1 and not words[-1]:
        words.pop()
    return (
        words,
        separator,
        separator != "," and any(DECIMAL_COMMA.fullmatch(word) for word in words),
    )


def _names(words: list[str], path: Path, line: str) -> list[str]:
    names = known_names(words)
    if not {"x", "y", "z"} <= set(names):
        raise CloudError(
            f"the first line is neither numbers nor names with x, y, z: {line.strip()[:60]!r}",
            file=path,
        )
    return names


def _commented(comments: list[str], count: int, separator: str | None) -> list[str] | None:
    """The names in a comment, when there is one for each column, x, y and z among them."""
    for words in (
        words for comment in comments for words in (comment.split(separator), comment.split())
    ):
        names = known_names([word.strip() for word in words])
        if len(names) == count and {"x", "y", "z"} <= set(names):
            return names
    return None


def _rows(path: Path, layout: _Layout) -> Iterator[str]:
    """Lines of numbers, without comments and without separators at their end."""
    for line in islice(_lines(path), layout.skip, None):
        if not COMMENT.match(line):
            yield line.rstrip().rstrip(layout.separator) if layout.separator else line


def _numbers(
    path: Path, layout: _Layout, usecols: int | None = None, dtype: Any = np.float64
) -> npt.NDArray[Any]:
    try:
        return _load(_rows(path, layout), layout.separator, usecols, dtype)
    except ValueError:
        rows = (_plain_row(line, layout) for line in _rows(path, layout))
    try:
        return _load(rows, None, usecols, dtype)
    except ValueError as fault:
        raise CloudError(
            f"has a row that is not numbers: {str(fault).split(';')[0]}", file=path
        ) from None


def _load(
    rows: Iterable[str], separator: str | None, usecols: int | None, dtype: Any
) -> npt.NDArray[Any]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*input contained no data")
        return np.loadtxt(rows, dtype, delimiter=separator, comments=None, ndmin=2, usecols=usecols)


def _plain_row(line: str, layout: _Layout) -> str:
    """A row whose odd numbers are written as others write them, separated by blanks."""
    words = line.split(layout.separator) if layout.separator else line.split()
    return " ".join(plain(word.strip().strip('"')) or "?" for word in words)


def _integers(
    path: Path, layout: _Layout, values: npt.NDArray[np.float64], index: int
) -> npt.NDArray[Any]:
    """A column as whole numbers of 32 or 64 bits, digit by digit, where all its values are such."""
    if not (np.isfinite(values).all() and (values == np.trunc(values)).all()):
        return values
    if not len(values) or np.abs(values).max() < 2**31 - 1:
        return values.astype(np.int32)
    if np.abs(values).max() < EXACT:
        return values.astype(np.int64)
    try:
        return _load(_rows(path, layout), layout.separator, index, np.int64)[:, 0]
    except (ValueError, OverflowError):
        _log.warning(
            "%s: column %d has whole numbers that 64 bits do not hold; they are rounded",
            path,
            index,
        )
        return values


def write(path: Path, records: Records) -> None:
    """A row a point: blanks and no names for .xyz, .txt, .asc and .pts, x, y, z first; names and
    commas for .csv.
    """
    columns = columns_of(records)
    csv = path.suffix.lower() == ".csv"
    names = (
        list(columns)
        if csv
        else [*(n for n in "xyz" if n in columns), *(n for n in columns if n not in "xyz")]
    )
    formats = {
        name: "%d" if column.dtype.kind in "iub" else "%.9g" for name, column in columns.items()
    }
    formats |= {name: "%.17g" for name, column in columns.items() if column.dtype == np.float64}
    separator = "," if csv else " "
    if not csv and names != ["x", "y", "z"]:
        _log.info("%s: no line of names; the columns are %s", path.name, ", ".join(names))
    header = ",".join(re.sub(r'[,;"\s]+', " ", name) for name in names) if csv else ""
    ordered = from_columns({name: columns[name] for name in names})
    line = separator.join(formats[name] for name in names)
    np.savetxt(path, ordered, line, header=header, comments="", encoding="utf-8")
