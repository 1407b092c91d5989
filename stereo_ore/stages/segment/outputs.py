"""What the network of lumps says of each pixel, rounded so that engines do not differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.network import logistic
from stereo_ore.stages.segment.channels import UNIT
from stereo_ore.types import F32

OUTPUTS = ("ore", "line", "offset_x", "offset_y", "log_size")
"""Logits of ore and of the contact line between lumps; where the middle of what is seen of the lump
lies from here [openings]; logarithm of the root of its area [openings]."""

GRID = 256
"""Outputs are rounded to 1/GRID before anything is decided by them: engines and processors differ
by less."""
_SMALLEST, _LARGEST = np.exp(-2.5), np.exp(1.8)
"""Bounds of a lump's diameter [openings]."""


@dataclass(frozen=True)
class Outputs:
    """What is said of each pixel (h, w): probability of ore and of contact, the middle (x, y) that
    it votes for [px], and the diameter of its lump [px].
    """

    ore: F32
    line: F32
    x: F32
    y: F32
    diameter: F32


def read(raw: F32) -> Outputs:
    """The outputs (5, h, w) of the network, in pixels and probabilities."""
    values = np.round(raw * np.float32(GRID)) / np.float32(GRID)
    ore, line, log_size = values[[0, 1, 4]].astype(np.float64)
    rows, columns = (np.arange(n, dtype=np.float32) for n in raw.shape[1:])
    return Outputs(
        logistic(ore),
        logistic(line),
        columns + values[2] * np.float32(UNIT),
        rows[:, None] + values[3] * np.float32(UNIT),
        np.asarray(np.clip(np.exp(log_size), _SMALLEST, _LARGEST) * UNIT, np.float32),
    )
