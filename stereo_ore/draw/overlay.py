"""The left image with what was found drawn on it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.stages.order import PASSES_HOLE
from stereo_ore.types import F64, I32, U8, ForeignBody, FrameResult, Json, Mask, Rig

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


Outlines = dict[int, list[I32]]
"""Contours (K, 1, 2) [px] of each lump, by its id."""


def draw_overlay(result: FrameResult, record: Json) -> U8 | None:
    """The left image with outlines, centres of gravity (+), strikes (arrow) and labels of all lumps
    of a frame's record.

    An oversize lump has a thick vermilion outline, one of unknown size a dashed yellow one, one
    that passes a thin blue one; what would be a target, were targets not withheld, is hatched. A
    label has the rank of a target (1 is first) before the id and size; labels lie on free ground,
    with a line to their lump where that is not beside it. None for a frame without an image.
    """
    image = draw_ground(result)
    if image is not None and result.pair is not None:
        draw_lumps(image, result.pair.rig, outlines(result), record)
    return image


def draw_ground(result: FrameResult) -> U8 | None:
    """The part of `draw_overlay` that a frame alone says: image, foreign bodies, what is
    withheld.
    """
    if result.pair is None:
        return None
    image = result.pair.left.copy()
    scale = image.shape[1] / 1280
    for body in result.foreign:
        _draw_foreign(image, body, scale)
    _hatch_withheld(image, result, scale)
    return image


def outlines(result: FrameResult) -> Outlines:
    """Contours of the lumps in the left image."""
    if result.ore_map is None:
        return {}
    masks = {ore.id: (result.ore_map.labels == ore.id).astype(np.uint8) for ore in result.ores}
    method = cv2.CHAIN_APPROX_NONE
    return {
        id: list(cv2.findContours(mask, cv2.RETR_EXTERNAL, method)[0]) for id, mask in masks.items()
    }


def draw_lumps(image: U8, rig: Rig, contours: Outlines, record: Json) -> None:
    """The part of `draw_overlay` that the frames before have a say in: lumps and targets, drawn
    on the ground.
    """
    scale = image.shape[1] / 1280
    for ore in record["ores"]:
        _draw_outline(image, contours.get(ore["id"], []), ore["oversize"], scale)
    for ore in record["ores"]:
        _draw_marks(image, rig, ore, ore["id"] in record["targets"][:1], scale)
    taken = _draw_banner(image, record, scale)
    rank = {id: place for place, id in enumerate(record["targets"], 1)}
    for ore in sorted(record["ores"], key=lambda o: rank.get(o["id"], len(rank) + o["id"])):
        at = _pixel(rig, ore["surface_centroid"]["camera"])
        taken.append(_draw_label(image, _label(ore, rank.get(ore["id"])), at, taken, scale))


def _draw_outline(image: U8, contours: Sequence[I32], oversize: bool | None, scale: float) -> None:
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


def _draw_marks(image: U8, rig: Rig, ore: Json, first: bool, scale: float) -> None:
    if ore["centre_of_gravity"]:
        at = _pixel(rig, ore["centre_of_gravity"]["camera"])
        cv2.drawMarker(image, at, CYAN, cv2.MARKER_CROSS, round(16 * scale), 2)
    if ore["strike"]:
        tip, direction = (np.array(ore["strike"][key]["camera"]) for key in ("point", "direction"))
        ends = (_pixel(rig, tip - _ARROW_LENGTH_M * direction), _pixel(rig, tip))
        thickness = max(1, round((3 if first else 2) * scale))
        cv2.arrowedLine(image, *ends, WHITE, thickness, cv2.LINE_AA, tipLength=0.3)
        cv2.circle(image, ends[1], round(4 * scale), WHITE, -1, cv2.LINE_AA)


def _label(ore: Json, rank: int | None) -> str:
    size = ""
    if ore["size_m"]:
        size = f" {1000 * ore['size_m'][0]:.0f}x{1000 * ore['size_m'][1]:.0f} mm"
    return f"{'' if rank is None else f'[{rank}] '}{ore['id']}{size}"


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


def _draw_banner(image: U8, record: Json, scale: float) -> list[_Box]:
    """What is said of the whole frame, and where it is written."""
    found = ", ".join(f"{record['counts'][name]} {name}" for name in ("ores", "targets"))
    lines = [
        f"{record['frame']}: {record['status']}, {found}",
        *(reason["code"] for reason in record["reasons"]),
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


def _pixel(rig: Rig, point: Sequence[float] | F64) -> tuple[int, int]:
    u, v = rig.project(np.array(point))
    return (round(float(u)), round(float(v))) if np.isfinite(u) else (-1, -1)
