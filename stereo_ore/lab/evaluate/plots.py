"""Errors against distance, size and visible share, as one PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereo_ore.draw.figures import new_figure, save_figure

ACROSS = {
    "distance_mm": "distance of the lump [mm]",
    "size_mm": "longest dimension [mm]",
    "visible_fraction": "visible share",
}
UP = {
    "iou": "IoU",
    "cog_rel": "centre of gravity, error / longest dimension",
    "volume": "volume, relative error",
}
_LIMITS = {"iou": 1.0, "cog_rel": 0.4, "volume": 1.0}
"""Errors beyond these are drawn on the upper edge, so that one outlier doesn't flatten the rest."""


def draw_plots(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG with a dot for every lump that had to be found; oversize lumps are filled."""
    lumps = [lump for row in rows for lump in row["lumps"]]
    figure = new_figure(12, 9, layout="constrained")
    axes = figure.subplots(len(UP), len(ACROSS), sharex="col", sharey="row")
    for i, (y, y_label) in enumerate(UP.items()):
        for j, (x, x_label) in enumerate(ACROSS.items()):
            _scatter(axes[i, j], lumps, x, y)
            if j == 0:
                axes[i, j].set_ylabel(y_label)
            if i == len(UP) - 1:
                axes[i, j].set_xlabel(x_label)
    figure.suptitle(
        f"{len(rows)} scenes, {len(lumps)} lumps that had to be found (filled: oversize)"
    )
    save_figure(figure, path, dpi=110)


def _scatter(axis: Any, lumps: Sequence[dict[str, Any]], x: str, y: str) -> None:
    for oversize in (False, True):
        shown = [lump for lump in lumps if y in lump and lump["is_oversize"] is oversize]
        face = "tab:red" if oversize else "none"
        heights = [min(lump[y], _LIMITS[y]) for lump in shown]
        axis.scatter(
            [lump[x] for lump in shown], heights, s=18, facecolors=face, edgecolors="tab:red"
        )
    axis.set_ylim(-0.02 * _LIMITS[y], 1.03 * _LIMITS[y])
    axis.grid(alpha=0.3)
