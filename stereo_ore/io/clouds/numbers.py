"""Numbers in text: decimal commas, the ways in which a NaN is written, whole columns that stay
whole.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError

NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|nan|inf(inity)?)", re.IGNORECASE
)
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
ODD_NAN = re.compile(
    r"[+-]?(\d*\.#?(q|s)?nan\w*|1\.#(ind|snan|qnan)\w*|nan[qs]|nan\([^)\s]*\))", re.IGNORECASE
)
ODD_INF = re.compile(r"([+-]?)1\.#inf\w*", re.IGNORECASE)

EXACT = 2**53
"""Whole numbers above are not all doubles."""


def is_number(word: str) -> bool:
    """Whether a word is a number, however a decimal point or a NaN is written."""
    return bool(
        NUMBER.fullmatch(word)
        or DECIMAL_COMMA.fullmatch(word)
        or ODD_NAN.fullmatch(word)
        or ODD_INF.fullmatch(word)
    )


def plain(word: str) -> str:
    """A number as Python reads it."""
    if NUMBER.fullmatch(word):
        return word
    if DECIMAL_COMMA.fullmatch(word):
        return word.replace(",", ".")
    if ODD_NAN.fullmatch(word):
        return "nan"
    return ODD_INF.sub(r"\1inf", word)


def column(words: Sequence[str], dtype: np.dtype[Any], name: str, path: Path) -> npt.NDArray[Any]:
    """Words as numbers of a type; what can't be one is an error."""
    try:
        if dtype.kind in "iu":
            return _whole(words, dtype, name, path)
        with np.errstate(over="ignore"):
            return np.array([float(plain(word)) for word in words], np.float64).astype(dtype)
    except ValueError as fault:
        problem = f"has a value that is not a number: {str(fault).rpartition(':')[2].strip()[:60]}"
        raise CloudError(f"{problem} (not numbers)", file=path, key=name) from None


def _whole(words: Sequence[str], dtype: np.dtype[Any], name: str, path: Path) -> npt.NDArray[Any]:
    limits = np.iinfo(dtype)
    values = [
        int(word) if re.fullmatch(r"[+-]?\d{1,19}", word) else float(plain(word)) for word in words
    ]
    if not all(value == value and limits.min <= value <= limits.max for value in values):
        raise CloudError(f"has a value that is no {dtype}", file=path, key=name)
    return np.array([int(value) for value in values], dtype)


def narrowest(values: npt.NDArray[np.float64]) -> npt.NDArray[Any]:
    """Doubles as floats of 32 bits where nine digits of those give the same doubles: they were such
    before.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        single = values.astype(np.float32)
        near = (
            np.isnan(values)
            | (values == single)
            | (np.abs(values - single) <= 5e-9 * np.abs(values))
        )
    if not near.all():
        return values
    finite = np.isfinite(values) & (values != single)
    same = all(
        float(f"{short:.9g}") == long
        for short, long in zip(single[finite], values[finite], strict=True)
    )
    return single if same else values
