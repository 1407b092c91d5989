"""The left image with what was found drawn on it."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.types import F64, U8, ForeignBody, FrameResult, Ore, Rig

_RED, AMBER, _GREEN, WHITE, BLACK, CYAN = (
    (60, 60, 255),
    (40, 180, 255),
    (110, 220, 90),
    (255, 255, 255),
    (0, 0, 0),
    (255, 230, 60),
)
MAGENTA = (200, 60, 220)
_ARROW_LENGTH_M = 0.15


def draw_overlay(result: FrameResult) -> U8 | None:
    """Outlines (oversize red, unknown amber, else green), ids, centres of gravity (+), strikes
    (arrow).

    None for a frame without an image.
    """
    if result.pair is None:
        return None
    image = result.pair.left.copy()
    scale = image.shape[1] / 1280
    for body in result.foreign:
        _draw_foreign(image, body, scale)
    for ore in result.ores:
        _draw_outline(image, result, ore, scale)
    for ore in result.ores:
        _draw_marks(image, result.pair.rig, ore, ore.id in result.targets[:1], scale)
    _draw_banner(image, result, scale)
    return image


def _colour(ore: Ore) -> tuple[int, int, int]:
    if ore.solid is None or ore.solid.oversize is None:
        return AMBER
    return _RED if ore.solid.oversize else _GREEN


def _draw_outline(image: U8, result: FrameResult, ore: Ore, scale: float) -> None:
    if result.ore_map is None:
        return
    mask = (result.ore_map.labels == ore.id).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, _colour(ore), max(1, round(2 * scale)), cv2.LINE_AA)


def _draw_foreign(image: U8, body: ForeignBody, scale: float) -> None:
    """Hatch a body that is no ore, and name it."""
    height, width = image.shape[:2]
    inside = cv2.fillPoly(np.zeros((height, width), np.uint8), [body.outline_px], 1) > 0
    v, u = np.indices((height, width))
    period = max(6, round(12 * scale))
    image[inside & ((u + v) % period < period / 4)] = MAGENTA
    cv2.polylines(image, [body.outline_px], True, MAGENTA, max(1, round(2 * scale)), cv2.LINE_AA)
    u0, v0 = body.outline_px.min(0)
    draw_text(image, f"no ore: {body.name}", (int(u0), int(v0) - round(4 * scale)), scale)


def _draw_marks(image: U8, rig: Rig, ore: Ore, first: bool, scale: float) -> None:
    if ore.solid is not None:
        cv2.drawMarker(
            image,
            _pixel(rig, ore.solid.centre_of_gravity),
            CYAN,
            cv2.MARKER_CROSS,
            round(16 * scale),
            2,
        )
    if ore.plan.strikes:
        strike = ore.plan.strikes[0]
        tip, tail = strike.point, strike.point - _ARROW_LENGTH_M * strike.direction
        thickness = max(1, round((3 if first else 2) * scale))
        cv2.arrowedLine(
            image, _pixel(rig, tail), _pixel(rig, tip), WHITE, thickness, cv2.LINE_AA, tipLength=0.3
        )
        cv2.circle(image, _pixel(rig, tip), round(4 * scale), WHITE, -1, cv2.LINE_AA)
    u, v = _pixel(rig, ore.surface_centroid)
    size = (
        ""
        if ore.solid is None
        else f" {1000 * ore.solid.size_m[0]:.0f}x{1000 * ore.solid.size_m[1]:.0f} mm"
    )
    draw_text(image, f"{ore.id}{size}", (u + round(8 * scale), v - round(8 * scale)), scale)


def _draw_banner(image: U8, result: FrameResult, scale: float) -> None:
    counts = result.counts
    lines = [
        f"{result.name}: {result.status}, {counts['ores']} ores, {counts['targets']} targets",
        *(reason.code for reason in result.reasons),
    ]
    for row, line in enumerate(lines):
        draw_text(image, line, (round(10 * scale), round((24 + 22 * row) * scale)), scale)


def draw_text(image: U8, text: str, at: tuple[int, int], scale: float) -> None:
    """White with a dark rim; the rim is the same text shifted, for a bolder font would be wider."""
    rim = max(1, round(scale))
    around = [(dx * rim, dy * rim, BLACK) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    for dx, dy, colour in [*around, (0, 0, WHITE)]:
        where = (at[0] + dx, at[1] + dy)
        cv2.putText(
            image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, colour, rim, cv2.LINE_AA
        )


def _pixel(rig: Rig, point: F64) -> tuple[int, int]:
    u, v = rig.project(point)
    return (round(float(u)), round(float(v))) if np.isfinite(u) else (-1, -1)
