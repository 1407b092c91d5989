"""LZF, the compression of binary_compressed PCD files (Marc Lehmann's LibLZF)."""

from __future__ import annotations

MOST_TIMES = 300
"""A byte of LZF stands for no more bytes than this."""


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes in LZF data: runs of literals (a length below 32) and copies of what came
    before.

    Raises
    ------
    ValueError
        When the data are damaged.
    """
    out, at = bytearray(), 0
    try:
        while at < len(data) and len(out) <= size:
            control, at = data[at], at + 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length, at = length + data[at], at + 1
            back = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _copy(out, back, length + 2)
    except IndexError:
        raise ValueError("the compressed data end too early") from None
    if len(out) != size:
        raise ValueError(f"the compressed data hold {len(out):,} bytes, the header says {size:,}")
    return bytes(out)


def _copy(out: bytearray, back: int, length: int) -> None:
    """Append `length` bytes from `back` on; they may reach into what is being appended."""
    if back < 0:
        raise ValueError("the compressed data refer to what was before their begin")
    chunk = out[back : back + length]
    out += (chunk * (length // len(chunk) + 1))[:length]
