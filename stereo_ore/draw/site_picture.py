"""What a site says of the screen, drawn on the left image, for a person to confirm."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stereo_ore.draw.overlay import AMBER, CYAN, WHITE, draw_text
from stereo_ore.types import F64, U8, Bars, Plane, RectifiedPair, Rig, Site, Volume

STEPS = 60
"""Pieces of a line, each drawn where it is before the camera."""


def draw_site(pair: RectifiedPair, site: Site, bars: Bars | None) -> U8:
    """Edges of the bars (white), the working volume's floor at the bar tops (cyan) and its lid
    (amber), and the numbers.
    """
    image = pair.left.copy()
    scale = image.shape[1] / 1280
    if site.volume is not None:
        for start, end, lid in _edges(site.volume):
            _line(image, pair.rig, start, end, AMBER if lid else CYAN, scale)
    if site.plane is not None and site.volume is not None and bars is not None:
        for start, end in _bar_edges(site.plane, site.volume, bars):
            _line(image, pair.rig, start, end, WHITE, scale)
    for row, text in enumerate(site_numbers(site)):
        draw_text(image, text, (round(10 * scale), round((24 + 22 * row) * scale)), scale)
    return image


def site_numbers(site: Site) -> Iterator[str]:
    """What a person can measure on the screen itself."""
    if site.opening_m is not None and site.bar_width_m is not None:
        yield f"opening {1000 * site.opening_m:.0f} mm, bars {1000 * site.bar_width_m:.0f} mm wide"
    if site.plane is not None:
        tilt = np.degrees(np.arccos(-site.plane.normal[2]))
        yield f"bar tops {-site.plane.offset:.3f} m from the camera, seen {tilt:.1f} deg off"
    if site.volume is not None:
        x, y, _ = site.volume.max_m - site.volume.min_m
        yield f"working volume {x:.2f} x {y:.2f} m, {site.volume.max_m[2]:.2f} m over the bars"


def _edges(volume: Volume) -> Iterator[tuple[F64, F64, bool]]:
    low, high = volume.min_m, volume.max_m
    ring = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    for z, lid in ((0.0, False), (float(high[2]), True)):
        corners = [_camera(volume, np.array([*xy, z])) for xy in ring]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            yield start, end, lid


def _bar_edges(plane: Plane, volume: Volume, bars: Bars) -> Iterator[tuple[F64, F64]]:
    """Both edges of each bar as long as the volume; the volume is the screen's own."""
    rows = volume.T_box_camera[:2, :3]
    if abs(float(rows[0] @ bars.across)) < 0.999:
        return
    foot = volume.T_box_camera[:3, :3].T @ -volume.T_box_camera[:3, 3]
    first = float(foot @ bars.across) - bars.phase_m
    low, high = volume.min_m, volume.max_m
    start = np.ceil((low[0] + first) / bars.pitch_m)
    for number in np.arange(start, (high[0] + first) / bars.pitch_m + 1e-9):
        for side in (-0.5, 0.5):
            x = number * bars.pitch_m - first + side * bars.width_m
            yield (
                _camera(volume, np.array([x, low[1], 0.0])),
                _camera(volume, np.array([x, high[1], 0.0])),
            )


def _camera(volume: Volume, point: F64) -> F64:
    return np.asarray((point - volume.T_box_camera[:3, 3]) @ volume.T_box_camera[:3, :3])


def _line(
    image: U8, rig: Rig, start: F64, end: F64, colour: tuple[int, int, int], scale: float
) -> None:
    share = np.linspace(0, 1, STEPS)[:, None]
    points = start + share * (end - start)
    pixels = rig.project(points[points[:, 2] > 0.05 * abs(start[2])])
    if len(pixels) > 1:
        line = np.rint(np.clip(pixels, -30_000, 30_000)).astype(np.int32)
        cv2.polylines(image, [line], False, colour, max(1, round(2 * scale)), cv2.LINE_AA)
