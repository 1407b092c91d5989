"""The left image with what was found drawn on it."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.stages.order import PASSES_HOLE
from stereo_ore.types import F64, I32, U8, ForeignBody, FrameResult, Mask, Ore, Rig

_VERMILION, AMBER, _SKY, WHITE, BLACK, CYAN = (
    (0, 94, 235),
    (66, 228, 240),
    (233, 180, 86),
    (255, 255, 255),
    (0, 0, 0),
    (255, 230, 60),
)
"""Those of outlines can be told apart with any colour vision (Okabe & Ito 2008)."""
MAGENTA = (200, 60, 220)
_ARROW_LENGTH_M = 0.15
_DASH_PX, _GAP_PX = 12, 8
_TEXT = 0.5
"""Size of OpenCV's font in a picture 1280 px wide."""


_Box = tuple[int, int, int, int]
"""Left, top, right, bottom [px]."""


def draw_overlay(result: FrameResult) -> U8 | None:
    """Outlines, centres of gravity (+), strikes (arrow) and labels of all lumps.

    An oversize lump has a thick vermilion outline, one of unknown size a dashed yellow one, one
    that passes a thin blue one; what would be a target, were targets not withheld, is hatched. A
    label has the rank of a target (1 is first) before the id and size; labels lie on free ground,
    with a line to their lump where that is not beside it. None for a frame without an image.
    """
    if result.pair is None:
        return None
    image = result.pair.left.copy()
    scale = image.shape[1] / 1280
    for body in result.foreign:
        _draw_foreign(image, body, scale)
    _hatch_withheld(image, result, scale)
    for ore in result.ores:
        _draw_outline(image, result, ore, scale)
    for ore in result.ores:
        _draw_marks(image, result.pair.rig, ore, ore.id in result.targets[:1], scale)
    taken = _draw_banner(image, result, scale)
    rank = {id: place for place, id in enumerate(result.targets, 1)}
    for ore in sorted(result.ores, key=lambda ore: rank.get(ore.id, len(rank) + ore.id)):
        at = _pixel(result.pair.rig, ore.surface_centroid)
        taken.append(_draw_label(image, _label(ore, rank.get(ore.id)), at, taken, scale))
    return image


def _draw_outline(image: U8, result: FrameResult, ore: Ore, scale: float) -> None:
    if result.ore_map is None:
        return
    mask = (result.ore_map.labels == ore.id).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    oversize = None if ore.solid is None else ore.solid.oversize
    if oversize is None:
        dashes = [dash for contour in contours for dash in _dashes(contour, scale)]
        cv2.polylines(image, dashes, False, AMBER, max(1, round(2 * scale)), cv2.LINE_AA)
        return
    colour, width = (_VERMILION, 3) if oversize else (_SKY, 1.5)
    cv2.drawContours(image, contours, -1, colour, max(1, round(width * scale)), cv2.LINE_AA)


def _dashes(contour: I32, scale: float) -> list[I32]:
    """Pieces of a contour (K, 1, 2) with gaps between."""
    dash, gap = max(2, round(_DASH_PX * scale)), max(2, round(_GAP_PX * scale))
    return [contour[start : start + dash] for start in range(0, len(contour), dash + gap)]


def _draw_foreign(image: U8, body: ForeignBody, scale: float) -> None:
    """Hatch a body that is no ore, and name it."""
    height, width = image.shape[:2]
    inside = cv2.fillPoly(np.zeros((height, width), np.uint8), [body.outline_px], 1) > 0
    _hatch(image, inside, MAGENTA, scale, 1)
    cv2.polylines(image, [body.outline_px], True, MAGENTA, max(1, round(2 * scale)), cv2.LINE_AA)
    u0, v0 = body.outline_px.min(0)
    draw_text(image, f"no ore: {body.name}", (int(u0), int(v0) - round(4 * scale)), scale)


def _hatch(image: U8, inside: Mask, colour: tuple[int, int, int], scale: float, lean: int) -> None:
    """Lines that fall to the left (1) or to the right (-1) over a part of the image."""
    v, u = np.indices(inside.shape)
    period = max(6, round(12 * scale))
    image[inside & ((u + lean * v) % period < period / 4)] = colour


def _hatch_withheld(image: U8, result: FrameResult, scale: float) -> None:
    """Hatch what would be a target, were targets not withheld: the banner says for what reason."""
    if not result.withheld or result.ore_map is None:
        return
    able = [
        ore.id
        for ore in result.ores
        if ore.plan.strikes and all(reason.code != PASSES_HOLE.code for reason in ore.reasons)
    ]
    _hatch(image, np.isin(result.ore_map.labels, able), WHITE, scale, -1)


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


def _label(ore: Ore, rank: int | None) -> str:
    size = ""
    if ore.solid is not None:
        size = f" {1000 * ore.solid.size_m[0]:.0f}x{1000 * ore.solid.size_m[1]:.0f} mm"
    return f"{'' if rank is None else f'[{rank}] '}{ore.id}{size}"


def _draw_label(image: U8, text: str, at: tuple[int, int], taken: list[_Box], scale: float) -> _Box:
    """Write beside a place where nothing is written yet, else as near as there is room."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT * scale, 1)
    step = height + below + 2
    places = [
        (at[0] + side * round(8 * scale) - (width if side < 0 else 0), at[1] + row * step)
        for row in (0, -1, 1, -2, 2, -3, 3, -4, 4)
        for side in (1, -1)
    ]
    boxes = [(u, v - height, u + width, v + below) for u, v in places]
    free = [box for box in boxes if _inside(box, image) and not any(_meet(box, t) for t in taken)]
    box = (free or boxes)[0]
    if abs(box[1] + height - at[1]) > step:
        end = (box[0] if box[0] > at[0] else box[2], (box[1] + box[3]) // 2)
        cv2.line(image, at, end, WHITE, max(1, round(scale)), cv2.LINE_AA)
    draw_text(image, text, (box[0], box[1] + height), scale)
    return box


def _inside(box: _Box, image: U8) -> bool:
    return min(box) >= 0 and box[2] < image.shape[1] and box[3] < image.shape[0]


def _meet(one: _Box, other: _Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _draw_banner(image: U8, result: FrameResult, scale: float) -> list[_Box]:
    """What is said of the whole frame, and where it is written."""
    counts = result.counts
    lines = [
        f"{result.name}: {result.status}, {counts['ores']} ores, {counts['targets']} targets",
        *(reason.code for reason in result.reasons),
    ]
    for row, line in enumerate(lines):
        draw_text(image, line, (round(10 * scale), round((24 + 22 * row) * scale)), scale)
    (width, _), _ = cv2.getTextSize(max(lines, key=len), cv2.FONT_HERSHEY_SIMPLEX, _TEXT * scale, 1)
    return [(0, 0, round(10 * scale) + width, round((12 + 22 * len(lines)) * scale))]


def draw_text(image: U8, text: str, at: tuple[int, int], scale: float) -> None:
    """White with a dark rim; the rim is the same text shifted, for a bolder font would be wider."""
    rim = max(1, round(scale))
    around = [(dx * rim, dy * rim, BLACK) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    for dx, dy, colour in [*around, (0, 0, WHITE)]:
        where = (at[0] + dx, at[1] + dy)
        cv2.putText(
            image, text, where, cv2.FONT_HERSHEY_SIMPLEX, _TEXT * scale, colour, rim, cv2.LINE_AA
        )


def _pixel(rig: Rig, point: F64) -> tuple[int, int]:
    u, v = rig.project(point)
    return (round(float(u)), round(float(v))) if np.isfinite(u) else (-1, -1)
