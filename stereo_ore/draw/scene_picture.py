"""A picture of what a frame gave, in space: screen, surface, solids, centres of gravity and
strikes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.draw.figures import new_figure
from stereo_ore.transforms import frame_from_normal
from stereo_ore.types import F64, U8, Bars, FrameResult, Grizzly, Ore, Surface

_OVERSIZE, _UNKNOWN, PASSES = "#d62f2f", "#e8962e", "#3f9b52"
INCHES, DPI = (10.0, 7.5), 100
ELEVATION_DEG, AZIMUTH_DEG = 38.0, -60.0
SURFACE_POINTS = 6000
_MARGIN = 0.12
"""Space around the solids as share of their extent."""
_ARROW = 0.12
"""Length of a strike's arrow as share of the picture's extent."""


def draw_scene(result: FrameResult) -> U8 | None:
    """Draw the solids (oversize red, unknown amber, else green) with centres of gravity and strikes
    as arrows.

    The frame drawn is the screen's: x across the bars, z along the normal, metres.

    Parameters
    ----------
    result
        A frame that reached the screen.

    Returns
    -------
    (H, W, 3) array or None
        BGR image; None when the frame has no screen.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    if result.grizzly is None:
        return None
    screen = _Screen(result.grizzly)
    figure = new_figure(*INCHES, dpi=DPI)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    hulls = [screen.place(ore.solid.vertices) for ore in result.ores if ore.solid is not None]
    low, high = _bounds(hulls)
    if result.surface is not None:
        _draw_surface(axes, result.surface, screen, low, high)
    if result.grizzly.bars is not None:
        _draw_bars(axes, result.grizzly.bars, low, high)
    for ore in result.ores:
        _draw_ore(
            axes,
            ore,
            screen,
            first=ore.id in result.targets[:1],
            arrow=_ARROW * float((high - low).max()),
        )
    _finish(
        axes, low, high, f"{result.name}: {len(result.ores)} ores, {len(result.targets)} targets"
    )
    return _render(figure)


class _Screen:
    """The screen's frame: x across the bars, or across the image when they are unknown, z along the
    normal.
    """

    def __init__(self, grizzly: Grizzly) -> None:
        across = np.array([1.0, 0.0, 0.0]) if grizzly.bars is None else grizzly.bars.across
        self.axes = frame_from_normal(grizzly.plane.normal, across)
        self.origin = grizzly.plane.offset * grizzly.plane.normal

    def place(self, xyz: npt.NDArray[Any]) -> F64:
        """Camera-frame points (..., 3) in this frame."""
        return np.asarray((np.asarray(xyz, np.float64) - self.origin) @ self.axes.T)


def _bounds(hulls: Sequence[F64]) -> tuple[F64, F64]:
    """Corners of a box around all points with a margin; one metre around the origin when there are
    none.
    """
    points = np.concatenate([*hulls, np.empty((0, 3))])
    if not len(points):
        return np.full(3, -0.5), np.full(3, 0.5)
    margin = _MARGIN * np.ptp(points, axis=0).max()
    return points.min(0) - margin, points.max(0) + margin


def _draw_surface(axes: Any, surface: Surface, screen: _Screen, low: F64, high: F64) -> None:
    """Scatter a thinned surface in its own colours, as far as it lies in the box."""
    points, colours = screen.place(surface.xyz.reshape(-1, 3)), surface.bgr.reshape(-1, 3)[:, ::-1]
    inside = np.nonzero(((points > low) & (points < high)).all(1))[0]
    inside = inside[:: max(1, len(inside) // SURFACE_POINTS)]
    axes.scatter(
        *points[inside].T, c=colours[inside] / 255.0, s=2.0, linewidths=0, alpha=0.6, zorder=1
    )


def _draw_bars(axes: Any, bars: Bars, low: F64, high: F64) -> None:
    """The bars that cross the box, as lines along y."""
    first, last = (
        np.ceil((low[0] - bars.phase_m) / bars.pitch_m),
        np.floor((high[0] - bars.phase_m) / bars.pitch_m),
    )
    for n in np.arange(first, last + 1):
        x = bars.phase_m + n * bars.pitch_m
        axes.plot(
            [x, x],
            [low[1], high[1]],
            [0.0, 0.0],
            color="#707070",
            linewidth=4.0,
            alpha=0.7,
            zorder=0,
        )


def _draw_ore(axes: Any, ore: Ore, screen: _Screen, first: bool, arrow: float) -> None:
    from scipy.spatial import ConvexHull

    if ore.solid is not None:
        colour = {True: _OVERSIZE, None: _UNKNOWN, False: PASSES}[ore.solid.oversize]
        vertices = screen.place(ore.solid.vertices)
        axes.plot_trisurf(
            *vertices.T,
            triangles=ConvexHull(vertices).simplices,
            color=colour,
            alpha=0.3,
            linewidth=0.3,
            zorder=2,
        )
        centre = screen.place(ore.solid.centre_of_gravity)
        axes.scatter(*centre[:, None], color="black", marker="+", s=70, zorder=4)
        axes.text(*centre, f" {ore.id}", zorder=5, fontsize=10)
    for rank, strike in enumerate(ore.plan.strikes):
        tip = screen.place(strike.point)
        tail = screen.place(strike.point - arrow * strike.direction)
        style = (
            {"color": "#1746d1" if first else "black", "linewidth": 2.2}
            if rank == 0
            else {"color": "#888888"}
        )
        axes.quiver(*tail, *(tip - tail), arrow_length_ratio=0.25, zorder=6, **style)


def _finish(axes: Any, low: F64, high: F64, title: str) -> None:
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), title=title)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="height [m]")
    axes.set_box_aspect(high - low)
    axes.set_position((0.02, 0.0, 0.96, 0.95))
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)


def _render(figure: Any) -> U8:
    figure.canvas.draw()
    rgba = np.asarray(figure.canvas.buffer_rgba())
    return np.ascontiguousarray(rgba[..., 2::-1])
