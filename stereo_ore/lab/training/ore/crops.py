"""Crops of examples, turned, scaled and spoilt at random, and what the network shall say there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from stereo_ore.lab.training.ore.examples import Example
from stereo_ore.stages.segment.channels import CHANNELS, UNIT
from stereo_ore.types import F32, F64, I32, U8

SIDE = 192
"""Pixels of a crop."""
ABOUT_A_LUMP, IN_CONTACT = 0.7, 0.5
"""Share of crops laid about a lump, and of those about one that others touch or hide."""
CLOSEST = 3
"""Lumps farther apart than this [px] have no contact line between them."""
_SMALLEST = 14
"""Lumps of fewer pixels are not aimed at."""
HEIGHT, NORMAL, RELIEF = 0, slice(1, 3), 3
_GEOMETRY, _DOUBTS, GREY, TEXTURE = slice(0, 8), slice(5, 8), 8, 9


@dataclass(frozen=True)
class Seen:
    """An example with what its lumps are: areas (n + 1,), middles (n + 1,) and contact line."""

    example: Example

    @cached_property
    def area(self) -> F64:
        """Pixels of each lump."""
        return np.bincount(self.example.lump.ravel()).astype(np.float64)

    @cached_property
    def middles(self) -> tuple[F64, F64]:
        """Mean column and row of what is seen of each lump."""
        lump = self.example.lump
        y, x = np.mgrid[: lump.shape[0], : lump.shape[1]]
        return (
            np.bincount(lump.ravel(), x.ravel()) / np.maximum(self.area, 1),
            np.bincount(lump.ravel(), y.ravel()) / np.maximum(self.area, 1),
        )

    @cached_property
    def line(self) -> U8:
        """1 where another lump is near, within a lump."""
        lump, near = self.example.lump, np.ones((CLOSEST, CLOSEST), np.uint8)
        lowest = cv2.erode(np.where(lump > 0, lump, np.uint8(255)), near)
        other = (cv2.dilate(lump, near) > lump) | (lowest < lump)
        return np.asarray((lump > 0) & other, np.uint8)

    @cached_property
    def aims(self) -> tuple[I32, I32]:
        """Lumps to aim at, and those of them that others touch."""
        large = np.flatnonzero(self.area > _SMALLEST)
        large = large[large > 0]
        contact = np.bincount(
            self.example.lump.ravel(), self.line.ravel(), minlength=len(self.area)
        )
        touched = large[contact[large] > 0.8 * np.sqrt(self.area[large])]
        return large.astype(np.int32), touched.astype(np.int32)


def training_crop(seen: Seen, rng: np.random.Generator) -> tuple[F32, F32]:
    """Channels (C, SIDE, SIDE) and targets (7, SIDE, SIDE) of a random piece.

    Targets are ore, contact line, offset to the middle of what is seen of the lump (2) and
    logarithm of the root of its area, both in units of `UNIT` pixels, area [px], and whether the
    example reaches there.
    """
    x, t, f = _piece(seen, rng)
    _spoil(x, f, rng)
    return _turned(x, t, rng)


def _piece(seen: Seen, rng: np.random.Generator) -> tuple[F32, F32, float]:
    """A square of the example, at most 1.4 times larger or smaller; and its factor."""
    k = round(SIDE / np.exp(rng.uniform(np.log(0.7), np.log(1.4))))
    f, lump = SIDE / k, seen.example.lump
    x0, y0 = _corner(seen, k, rng)
    h, w = lump.shape
    ya, yb, xa, xb = max(y0, 0), min(y0 + k, h), max(x0, 0), min(x0 + k, w)
    frame = [(ya - y0, y0 + k - yb), (xa - x0, x0 + k - xb)]

    def near(image: U8) -> U8:
        laid, exact = np.pad(image[ya:yb, xa:xb], frame), cv2.INTER_NEAREST_EXACT
        return np.asarray(cv2.resize(laid, (SIDE, SIDE), interpolation=exact), np.uint8)

    piece = seen.example.x[:, ya:yb, xa:xb].transpose(1, 2, 0).astype(np.float32)
    x = np.asarray(cv2.resize(np.pad(piece, [*frame, (0, 0)]), (SIDE, SIDE)), np.float32)
    mine, line, inside = near(lump), near(seen.line), near(np.ones_like(lump))
    ore, area = mine > 0, seen.area[mine] * f * f
    row, column = np.mgrid[:SIDE, :SIDE]
    dx, dy = (
        (((middle[mine] - corner + 0.5) * f - 0.5) - at) / UNIT * ore
        for middle, corner, at in zip(seen.middles, (x0, y0), (column, row), strict=True)
    )
    size = np.log(np.maximum(area, 1)) / 2 - np.log(UNIT)
    t = np.stack([ore, line, dx, dy, size, area, inside], -1).astype(np.float32)
    return x, t, f


def _corner(seen: Seen, k: int, rng: np.random.Generator) -> tuple[int, int]:
    """Upper left corner (x, y) of a square of side k."""
    h, w = seen.example.lump.shape
    x, y = rng.uniform(0, w), rng.uniform(0, h)
    large, touched = seen.aims
    if len(large) and rng.random() < ABOUT_A_LUMP:
        aim = touched if len(touched) and rng.random() < IN_CONTACT else large
        i = int(rng.choice(aim))
        x, y = (float(m[i] + rng.uniform(-0.4, 0.4) * k) for m in seen.middles)
    return (
        int(np.clip(x - k / 2, min(0, w - k), max(w - k, 0))),
        int(np.clip(y - k / 2, min(0, h - k), max(h - k, 0))),
    )


def _spoil(x: F32, f: float, rng: np.random.Generator) -> None:
    """Noise, holes, unknown doubts, other light or none, in place; heights scaled by f."""
    n = len(x)
    x[..., [HEIGHT, RELIEF]] *= f
    x[..., 4] = x[..., 4] > 0.5
    valid = x[..., 4]
    if rng.random() < 0.6:
        cell = int(rng.integers(3, 18))
        coarse = rng.normal(0, 1, (n // cell + 2,) * 2).astype(np.float32)
        z = cv2.resize(coarse, (n, n), interpolation=cv2.INTER_CUBIC)
        z = z * np.float32(rng.uniform(0, 0.03) * np.sqrt(cell / 5)) * valid
        gy, gx = np.gradient(z)
        x[..., :4] += np.stack([z, -gx * UNIT * valid, -gy * UNIT * valid, z], -1)
    x[..., HEIGHT] += np.float32(rng.normal(0, 0.03)) * valid
    x[..., NORMAL] = np.clip(x[..., NORMAL], -1, 1)
    if rng.random() < 0.4:
        gap = np.zeros((n, n), np.uint8)
        for _ in range(rng.integers(1, 6)):
            middle, axes = rng.integers(0, n, 2).tolist(), rng.integers(2, 20, 2).tolist()
            cv2.ellipse(gap, middle, axes, 0, 0, 360, 1, -1)
        x[gap > 0, _GEOMETRY] = 0
    if rng.random() < 0.15:
        x[..., _DOUBTS] = x[..., 4:5] * np.array([1, 0, 1], np.float32)
    if rng.random() < 0.35:
        x[..., GREY:] = 0
        return
    grey = x[..., GREY] * np.float32(rng.uniform(0.5, 1.5))
    grey += rng.normal(0, 1, (n, n)).astype(np.float32) * np.float32(rng.uniform(0, 0.15))
    x[..., GREY] = np.sign(grey) * np.abs(grey) ** np.float32(rng.uniform(0.7, 1.4))
    x[..., TEXTURE] += np.float32(rng.normal(0, 0.4))


def _turned(x: F32, t: F32, rng: np.random.Generator) -> tuple[F32, F32]:
    """Mirrored and turned by quarters, vectors too; channels first."""
    vectors = ((x, 1), (t, 2))
    if rng.random() < 0.5:
        x, t = x[:, ::-1].copy(), t[:, ::-1].copy()
        x[..., 1], t[..., 2] = -x[..., 1], -t[..., 2]
    for _ in range(rng.integers(4)):
        x, t = np.rot90(x).copy(), np.rot90(t).copy()
        vectors = ((x, 1), (t, 2))
        for a, i in vectors:
            a[..., i], a[..., i + 1] = a[..., i + 1].copy(), -a[..., i]
    return (
        np.ascontiguousarray(x.transpose(2, 0, 1)),
        np.ascontiguousarray(t.transpose(2, 0, 1)),
    )


assert len(CHANNELS) == TEXTURE + 1
