"""Faults in a part of the images: rows of another moment, water, drops, lost packets, flakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from stereo_ore.lab.bench.fault_scenes import Case, Planted, exposed
from stereo_ore.types import F32, U8

_Eyes = tuple[U8, U8]
Edit = Callable[[Planted, U8, U8, np.random.Generator], _Eyes]
BLOCK_PX, FLAKE_GREY = 16, 235


def plant_in_images(edit: Edit, planted: Planted, seed: int) -> Case:
    """The case with the last of two frames edited; both have the noise of their own moment."""
    case, rng = planted.case, np.random.default_rng([seed, 7])
    before, now = (exposed(case.frames[-1], 100 * seed + k) for k in (0, 1))
    left, right = edit(planted, now.left, now.right, rng)
    now = replace(now, left=np.ascontiguousarray(left), right=np.ascontiguousarray(right))
    return replace(case, frames=(before, now))


def _sampled(image: U8, du: F32 | float, dv: F32 | float = 0.0) -> U8:
    """The image with each pixel taken from (u + du, v + dv)."""
    v, u = np.indices(image.shape[:2]).astype(np.float32)
    columns, rows = np.asarray(u + du, np.float32), np.asarray(v + dv, np.float32)
    taken = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(taken, np.uint8)


def slipped_band(shift_px: int) -> Edit:
    """A band of a fifth of the right eye's rows comes some columns late: lost bytes of a line
    buffer.
    """

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        height = right.shape[0]
        top = int(rng.uniform(0.3, 0.5) * height)
        out = right.copy()
        out[top : top + height // 5] = np.roll(right[top : top + height // 5], shift_px, axis=1)
        return left, out

    return edit


def wobbling_rows(amplitude_px: float, both: bool = False) -> Edit:
    """Rows swing along themselves: a rolling shutter under vibration."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        height = right.shape[0]
        turns, phase = rng.uniform(2, 5), rng.uniform(0, 2 * np.pi)
        swing = amplitude_px * np.sin(2 * np.pi * turns * np.arange(height) / height + phase)
        du = np.asarray(swing, np.float32)[:, None]
        return _sampled(left, du) if both else left, _sampled(right, du)

    return edit


def film(bend_px: float, eye: int = 1) -> Edit:
    """A film of water over the middle of one eye's glass bends its rays along the rows."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        height, width = right.shape[:2]
        bump = _bell((height, width), rng.uniform(0.4, 0.6, 2), 0.25)
        eyes = [left, right]
        eyes[eye] = _sampled(eyes[eye], bend_px * bump)
        return eyes[0], eyes[1]

    return edit


def _bell(shape: tuple[int, int], middle: np.ndarray, width_share: float) -> F32:
    v, u = np.indices(shape) / shape[1]
    square = (u - middle[0]) ** 2 + (v - middle[1] * shape[0] / shape[1]) ** 2
    return np.asarray(np.exp(-0.5 * square / width_share**2), np.float32)


def magnifying_drop(gain: float, share: float = 0.1) -> Edit:
    """A drop on the right eye's glass magnifies what lies behind it."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        height, width = right.shape[:2]
        middle = rng.uniform(0.35, 0.65, 2) * (width, height)
        v, u = np.indices((height, width)).astype(np.float32)
        u, v = u - np.float32(middle[0]), v - np.float32(middle[1])
        inside = np.clip(1 - (u**2 + v**2) / (share * height * width / np.pi), 0, 1)
        return left, _sampled(right, -gain * u * inside, -gain * v * inside)

    return edit


def blurring_drop(share: float = 0.1) -> Edit:
    """A drop blurs a part of the right eye."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        height, width = right.shape[:2]
        u, v = (rng.uniform(0.35, 0.65, 2) * (width, height)).astype(int)
        part = np.zeros((height, width), np.float32)
        cv2.circle(part, (int(u), int(v)), int(np.sqrt(share * height * width / np.pi)), 1.0, -1)
        soft = cv2.GaussianBlur(part, (0, 0), 5)[..., None]
        blurred = cv2.GaussianBlur(right, (0, 0), 6)
        return left, np.rint(right * (1 - soft) + blurred * soft).astype(np.uint8)

    return edit


def lost_blocks(share: float) -> Edit:
    """Blocks of the right eye show what a decoder left in the block beside them."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        out = right.copy()
        rows, columns = right.shape[0] // BLOCK_PX, right.shape[1] // BLOCK_PX
        for place in rng.choice(rows * columns, int(share * rows * columns), replace=False):
            i, j = divmod(int(place), columns)
            at = slice(BLOCK_PX * i, BLOCK_PX * (i + 1))
            from_ = BLOCK_PX * max(j - 1, 0)
            out[at, BLOCK_PX * j : BLOCK_PX * (j + 1)] = right[at, from_ : from_ + BLOCK_PX]
        return left, out

    return edit


def flakes(count: int, size_m: float) -> Edit:
    """Snow in the air between camera and screen, seen by both eyes."""

    def edit(planted: Planted, left: U8, right: U8, rng: np.random.Generator) -> _Eyes:
        return _with_flakes(planted, left, right, rng, count, size_m)

    return edit


def _with_flakes(
    planted: Planted, left: U8, right: U8, rng: np.random.Generator, count: int, size_m: float
) -> _Eyes:
    rig, plane = planted.rig, planted.case.site.plane
    assert plane is not None, "the plane is known"
    eyes = (left.copy(), right.copy())
    z = rng.uniform(0.5, 0.95, count) * abs(plane.offset)
    u, v = rng.uniform(0, rig.width, count), rng.uniform(0, rig.height, count)
    size = size_m * rng.uniform(0.6, 1.4, count) * rig.fx / z / 2
    for k in np.argsort(-z):
        for eye, shift in zip(eyes, (0.0, float(rig.disparity(z[k]))), strict=True):
            middle = (round(16 * (u[k] - shift)), round(16 * v[k]))
            cv2.circle(
                eye, middle, max(round(16 * size[k]), 8), (FLAKE_GREY,) * 3, -1, cv2.LINE_AA, 4
            )
    return eyes


EDITS: dict[str, Edit] = {
    **{f"band slipped {d:+d} px": slipped_band(d) for d in (-8, 4, 8, 16)},
    **{f"rows wobble {a} px, right": wobbling_rows(a) for a in (1, 3)},
    "rows wobble 6 px, both": wobbling_rows(6, both=True),
    **{f"film bends right {d:+d} px": film(d) for d in (-3, 2)},
    "film bends left +5 px": film(5, eye=0),
    "drop magnifies 6 %": magnifying_drop(0.06),
    "drop blurs 10 % of right": blurring_drop(),
    **{f"blocks lost {100 * s:.0f} %": lost_blocks(s) for s in (0.03, 0.15)},
    "120 large flakes": flakes(120, 0.06),
    "600 flakes": flakes(600, 0.02),
}
"""Edits of the last of two frames; for raw images not of their geometry, but of what a sensor
gives."""
