"""How far a screen reaches: where its bars are solid and its gaps are open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.config import GrizzlyConfig
from stereo_ore.stages.grizzly.bars import rays_in_plane
from stereo_ore.stages.grizzly.sample import draw_sample
from stereo_ore.types import F64, Grizzly, Mask, Surface

_SAMPLE = 60_000
_LIMITS = (0.6, 1.2)
"""Within the first of these of a plane [inlier distances] it is solid, beneath the second open."""
CELL = 0.5
"""Side of the cells that are judged, in pitches along the bars; across it is a pitch."""
_FEWEST = 4
"""Points on a bar and in a gap that tell of a cell."""
_FEW = 0.2
"""Share of the cells of the fullest line that one at the screen's end must have."""
SOLID, _OPEN = 0.3, -0.1
"""Mean of +1 for solid and −1 for open on the bar of a cell, and in its gap."""


@dataclass(frozen=True)
class Extent:
    """Where a screen is, across and along its bars (2,) [m], from the bars' phase and the foot of
    the camera.
    """

    low: F64
    high: F64


def extent(surface: Surface, screen: Grizzly, config: GrizzlyConfig) -> Extent | None:
    """The rectangle about the largest connected part of the plane that is cut into bars.

    A floor is solid everywhere and a pit is open everywhere; ore hides bars, and is bridged where
    bars go on behind it. None where no cell shows bars.
    """
    bars = screen.bars
    if bars is None:
        return None
    sample = draw_sample(surface, config, _SAMPLE)
    q, signal, axes = rays_in_plane(sample, screen.plane, _LIMITS)
    across = q @ (axes @ bars.across) - bars.phase_m
    along = q @ (axes @ bars.direction)
    number = np.round(across / bars.pitch_m)
    on_bar = np.abs(across - number * bars.pitch_m) < bars.width_m / 2
    side = np.array([bars.pitch_m, CELL * bars.pitch_m])
    cell = np.stack([number, np.floor(along / side[1])], 1).astype(np.intp)
    first = cell.min(0)
    shown = _cut_into_bars(cell - first, on_bar, signal)
    part = _largest(shown)
    if not part.any():
        return None
    ends = [_ends(part.sum(1)), _ends(part.sum(0))]
    low, high = (np.array(end) + first for end in zip(*ends, strict=True))
    # Cells are centred on bars across them, and begin at their floor along them.
    return Extent((low - np.array([0.5, 0])) * side, (high + np.array([0.5, 1])) * side)


def _ends(cells: np.ndarray) -> tuple[int, int]:
    """First and last line that has some of the cells (n,) that the fullest one has: a floor may
    look like bars in a few.
    """
    full = np.flatnonzero(cells > _FEW * cells.max())
    return int(full[0]), int(full[-1])


def over(surface: Surface, screen: Grizzly, config: GrizzlyConfig) -> Surface:
    """The surface without what lies beside the screen: frame, floor, walls and what stands there.

    For sites without a working volume. Nothing is taken away where no bars are known.
    """
    reach, bars = extent(surface, screen, config), screen.bars
    if reach is None or bars is None:
        return surface
    # The outermost cells are half frame.
    margin = np.array([0.5 * (bars.pitch_m - bars.width_m), 0.0])
    beside = ~np.isfinite(surface.xyz[..., 2])
    coordinates = (
        surface.xyz @ bars.across.astype(np.float32) - np.float32(bars.phase_m),
        surface.xyz @ bars.direction.astype(np.float32),
    )
    ends = zip(coordinates, reach.low + margin, reach.high - margin, strict=True)
    with np.errstate(invalid="ignore"):
        for coordinate, low, high in ends:
            beside |= (coordinate < low) | (coordinate > high)
    return replace(surface, xyz=np.where(beside[..., None], np.float32(np.nan), surface.xyz))


def _cut_into_bars(cell: np.ndarray, on_bar: Mask, signal: F64) -> Mask:
    """Cells (n, m) whose bar is solid beside an open gap."""
    shape = tuple(cell.max(0) + 1)
    flat = np.ravel_multi_index((cell[:, 0], cell[:, 1]), shape)
    means = []
    for part in (on_bar, ~on_bar):
        count = np.bincount(flat[part], minlength=shape[0] * shape[1])
        total = np.bincount(flat[part], signal[part], shape[0] * shape[1])
        means.append(np.where(count >= _FEWEST, total / np.maximum(count, 1), 0.0).reshape(shape))
    return np.asarray((means[0] > SOLID) & (means[1] < _OPEN))


def _largest(shown: Mask) -> Mask:
    """The largest part; cells that touch, or have one cell between them, belong together."""
    closed = cv2.dilate(shown.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(closed, connectivity=8)
    sizes = np.bincount(labels[shown], minlength=count)
    return np.asarray(shown & (labels == int(sizes.argmax())))
