"""Pictures of filtering: outlier factors as circles (the paper's Figure 4), filters side by side
(its Figure 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.draw.figures import new_figure, save_figure
from stereo_ore.types import Mask

_SHOWN = 60_000
"""More points than this are thinned evenly: a picture has no room for them."""

LARGEST_CIRCLE = 120.0
SURFACE, _NOISE = "#4c6272", "#d62728"
_Array = npt.NDArray[Any]


def outlier_factors(xyz: _Array, score: _Array, path: Path) -> None:
    """Draw points from above, each with a red circle whose area grows with its score between the 50
    % and 99.5 % rank.

    Parameters
    ----------
    xyz : (M, 3) array
        Points, any unit.
    score : (M,) array
        Higher is noisier.
    path : Path
        PNG, PDF or SVG.
    """
    rows = _shown(xyz)
    finite = np.where(
        np.isfinite(score[rows]), score[rows], np.nanmax(score[np.isfinite(score)], initial=0)
    )
    low, high = np.quantile(finite, (0.5, 0.995)) if len(finite) else (0.0, 1.0)
    size = np.clip((finite - low) / max(high - low, 1e-12), 0, 1)
    across, up = _view(xyz)
    figure, (axes,) = panels(1)
    axes.scatter(xyz[rows, across], xyz[rows, up], s=0.5, c=SURFACE, linewidths=0)
    circles = {
        "s": size * LARGEST_CIRCLE,
        "facecolors": "none",
        "edgecolors": _NOISE,
        "linewidths": 0.5,
    }
    axes.scatter(xyz[rows, across], xyz[rows, up], **circles)
    axes.set_title("outlier factor: the larger the circle, the more likely noise")
    save_figure(figure, path)


def side_by_side(xyz: _Array, keeps: Mapping[str, Mask], path: Path) -> None:
    """Draw what each filter keeps (grey) and removes (red), seen along the cloud's middle extent.

    Parameters
    ----------
    xyz : (M, 3) array
        Points, any unit.
    keeps : mapping
        Title of a panel to its mask (M,).
    path : Path
        PNG, PDF or SVG.
    """
    rows = _shown(xyz)
    across, up = _view(xyz)
    figure, all_axes = panels(len(keeps))
    for axes, (title, keep) in zip(all_axes, keeps.items(), strict=True):
        colours = np.where(keep[rows], SURFACE, _NOISE)
        axes.scatter(
            xyz[rows, across],
            xyz[rows, up],
            s=np.where(keep[rows], 0.5, 2.0),
            c=colours,
            linewidths=0,
        )
        axes.set_title(f"{title}: {int((~keep).sum()):,} of {len(keep):,} removed")
    save_figure(figure, path)


def _shown(xyz: _Array) -> npt.NDArray[np.int64]:
    """Finite rows, evenly thinned."""
    rows = np.flatnonzero(np.isfinite(xyz).all(1))
    return rows[:: max(1, -(-len(rows) // _SHOWN))]


def _view(xyz: _Array) -> tuple[int, int]:
    """The two axes along which the cloud is widest, in order."""
    finite = xyz[np.isfinite(xyz).all(1)]
    spread = np.ptp(finite, axis=0) if len(finite) else np.zeros(3)
    across, up = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    return across, up


def panels(count: int, maps: bool = True) -> tuple[Any, list[Any]]:
    """A figure and its axes; those of maps have equal scales and no frame.

    Raises
    ------
    MissingExtraError
        When matplotlib is not installed.
    """
    columns = min(count, 3)
    lines = -(-count // columns)
    figure = new_figure(5 * columns, 5.5 * lines, dpi=130, layout="constrained")
    all_axes = list(figure.subplots(lines, columns, squeeze=False).ravel())
    for axes in all_axes if maps else all_axes[count:]:
        axes.set_axis_off()
    for axes in all_axes if maps else ():
        axes.set_aspect("equal")
    return figure, all_axes[:count]
