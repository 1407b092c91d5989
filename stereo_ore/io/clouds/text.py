"""Text clouds: XYZ and CSV, separated by commas, semicolons or blanks, with or without a line of names."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.records import COLUMNS, Records, from_array, from_columns, require_xyz

LONGEST_LINE = 100_000
NUMBER = re.compile(r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|nan|inf(inity)?)", re.IGNORECASE)


def read(path: Path) -> Records:
    """Rows of numbers; the first three columns are x, y, z unless a line of names says otherwise."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = next((line for line in file if line.strip() and not line.startswith(("#", "//"))), "")
    if len(first) > LONGEST_LINE:
        raise CloudError(f"the first line has {len(first):,} characters", file=path, remedy="Is it a table of points?")
    separator = next((s for s in (",", ";") if s in first), None)
    words = [word.strip().strip('"') for word in first.split(separator)]
    named = bool(first) and not all(NUMBER.fullmatch(word) for word in words)
    if named and not {"x", "y", "z"} <= {word.lower() for word in words}:
        raise CloudError(f"the first line is neither numbers nor names with x, y, z: {first.strip()[:60]!r}", file=path)
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = (line for line in file if line.strip() and not line.startswith("//"))
        values = _numbers(islice(lines, _names_end(path) if named else 0, None), separator, path)
    if not len(values):
        values = np.empty((0, max(len(words), 3) if first else 3))
    if not named:
        return from_array(values, path)
    if len(words) != values.shape[1]:
        raise CloudError(f"has {len(words)} names for {values.shape[1]} columns", file=path)
    lower = [word.lower() if word.lower() in COLUMNS else word for word in words]
    if len(set(lower)) < len(lower) or "" in lower:
        raise CloudError("has a column name twice, or a column without a name", file=path)
    return require_xyz(from_columns({name: values[:, i] for i, name in enumerate(lower)}), path)


def _names_end(path: Path) -> int:
    """Non-blank lines up to and with the line of names."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = (line for line in file if line.strip() and not line.startswith("//"))
        return next(i + 1 for i, line in enumerate(lines) if not line.startswith("#"))


def _numbers(lines: Any, separator: str | None, path: Path) -> Any:
    import warnings

    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*input contained no data")
            return np.loadtxt(lines, delimiter=separator, comments="#", ndmin=2)
    except ValueError as fault:
        raise CloudError(f"has a row that is not numbers: {str(fault).split(';')[0]}", file=path) from None


def parse_rows(file: IO[bytes], dtype: np.dtype[np.void], count: int, path: Path) -> Records:
    """Exactly `count` blank-separated rows from the file's position."""
    if count == 0:
        return np.empty(0, dtype)
    values = _numbers((line.decode("ascii", "replace") for line in islice(file, count)), None, path)
    names = dtype.names or ()
    if values.shape != (count, len(names)):
        rows, columns = values.shape
        raise CloudError(
            f"has {rows:,} rows of {columns} numbers; the header says {count:,} of {len(names)}", file=path
        )
    return from_columns({name: _cast(values[:, i], dtype[name], name, path) for i, name in enumerate(names)})


def _cast(values: Any, dtype: np.dtype[Any], name: str, path: Path) -> Any:
    """A column in the type that the header says; what a whole number can't be is an error."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        if not np.all((values >= limits.min) & (values <= limits.max)):
            raise CloudError(f"has a value that is no {dtype}", file=path, key=name)
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype)


def write(path: Path, records: Records) -> None:
    """A row a point: blanks and no names for .xyz and .txt, commas and a line of names for .csv."""
    names = records.dtype.names or ()
    formats = ["%d" if records.dtype[name].kind in "iub" else "%.9g" for name in names]
    formats = ["%.17g" if records.dtype[name] == np.float64 else f for name, f in zip(names, formats, strict=True)]
    csv = path.suffix.lower() == ".csv"
    separator = "," if csv else " "
    np.savetxt(path, records, separator.join(formats), header=separator.join(names) if csv else "", comments="")
