"""Lumps of scenes whose truth is known, as samples that the coefficients of `stereo_ore.solid.prior` are fitted to."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy.ndimage import find_objects

from stereo_ore.solid.cues import gather
from stereo_ore.solid.prior import TARGETS
from stereo_ore.solid.sight import look
from stereo_ore.types import F32, F64, I16, U8, Bars, Mask, Plane, Rig, Surface

Appearance = Literal["true", "worn", "outlined", "measured"]
"""How a scene is seen: as it is; worn as by a matcher and a segmenter; with the disparity that the program measured
and true outlines; with measured disparity and outlines. The last two need the scene's measured.npz: `disparity`
(H, W) [px], 0 = none, of the points that the filter kept, and `ore_map` (H, W)."""
FIRST_LUMP = 2
MIN_PIXELS, MIN_VISIBLE = 400, 0.3
NOISE_PX = 0.15
"""Standard deviation of a matcher's disparity noise away from outlines."""
NOISE_AT_OUTLINE = 2.0
"""How many times larger it is at an outline, falling off over two pixels."""
HOLES_AT_OUTLINE = 0.2
"""Share of pixels without disparity at an outline, falling off over two pixels."""
SHIFT_PX, MISMATCH_PX, SHIFT_REACH_PX = 0.6, 0.6, 6.0
"""Random displacement of outlines, of labels against depth besides, and the distance over which both vary."""
MIN_OVERLAP = 0.5
"""Intersection over union from which on a measured lump is a true one."""


@dataclass(frozen=True)
class Sample:
    """A lump: its cues, doubts and truth (as `TARGETS` and y), the weight and fold of its scene."""

    even: Mapping[str, float]
    odd: Mapping[str, float]
    doubts: Mapping[str, float]
    truth: Mapping[str, float]
    weight: float
    fold: int


def samples(folder: Path, seen_as: Appearance, weight: float, fold: int) -> Iterator[Sample]:
    """The lumps of a scene that are seen well enough to be judged; `fold` also seeds the wear."""
    truth = json.loads((folder / "gt.json").read_text(encoding="utf-8"))
    if seen_as in ("outlined", "measured") and not (folder / "measured.npz").exists():
        return
    surface, labels, true_labels, T_left_screen = _scene(folder, seen_as, fold)
    plane = Plane(T_left_screen[:3, 2], float(T_left_screen[:3, 2] @ T_left_screen[:3, 3]))
    bars, opening = _bars(truth, T_left_screen, plane), truth["clear_opening_mm"] / 1000
    boxes = find_objects(labels)
    for lump in truth["lumps"]:
        number = lump["id"] - FIRST_LUMP + 1
        seen = lump["visible_pixels"] >= MIN_PIXELS and lump["visible_fraction"] >= MIN_VISIBLE
        if seen_as == "measured":
            number = _counterpart(labels, true_labels == number)
        if not seen or lump["cut_by_image_border"] or not 0 < number <= len(boxes) or boxes[number - 1] is None:
            continue
        sight = look(surface, labels, boxes[number - 1], number, plane, MIN_PIXELS // 4)
        cues = gather(sight, bars, opening) if sight else None
        if sight is None or cues is None:
            continue
        centre = np.array(lump.get("com_left_rect_mm", lump["com_left_mm"])) / 1000
        local = (sight.axes @ (centre - sight.origin) - [0.0, 0.0, cues.support]) / sight.size
        sizes = np.array([lump["max_caliper_mm"], *lump["obb_dims_mm"][1:]]) / 1000 / sight.size
        target = (local[0], local[2], np.log(lump["volume_mm3"] * 1e-9 / sight.size**3), *np.log(sizes))
        found = dict(zip(TARGETS, map(float, target), strict=True)) | {"y": float(local[1])}
        yield Sample(cues.even, cues.odd, cues.doubts, found, weight, fold)


def _counterpart(labels: I16, lump: Mask) -> int:
    """The label that overlaps a true lump enough to be it, or 0."""
    found = [int(label) for label in np.unique(labels[lump]) if label > 0]
    overlap = {n: float((lump & (labels == n)).sum() / (lump | (labels == n)).sum()) for n in found}
    best = max(overlap, key=overlap.__getitem__, default=0)
    return best if overlap.get(best, 0.0) >= MIN_OVERLAP else 0


def _scene(folder: Path, seen_as: Appearance, seed: int) -> tuple[Surface, I16, I16, F64]:
    """Surface, lumps' labels as seen and as they are, and the screen's pose of a scene folder."""
    calib = json.loads((folder / "calib.json").read_text(encoding="utf-8"))
    truth = json.loads((folder / "gt.json").read_text(encoding="utf-8"))
    arrays, T = np.load(folder / "gt.npz"), np.array(truth["T_left_screen"], float)
    T[:3, 3] /= 1000
    if calib.get("rectified", True):
        K, fb, suffix = np.array(calib["K"]), calib["K"][0][0] * calib["baseline_mm"] / 1000, ""
    else:
        reference = calib["reference_rectification"]
        K, fb, suffix = np.array(reference["P1"])[:, :3], -reference["P2"][0][3] / 1000, "_rect"
        T[:3] = np.array(reference["R1"]) @ T[:3]
    depth, instance = arrays[f"depth_left{suffix}_mm"] / 1000.0, arrays[f"instance_left{suffix}"]
    true_labels = np.maximum(instance.astype(np.int16) - FIRST_LUMP + 1, 0).astype(np.int16)
    disparity = np.where(depth > 0, fb / np.maximum(depth, 1e-6), 0.0).astype(np.float32)
    disparity, labels = _seen(folder, seen_as, disparity, true_labels, seed)
    rig = Rig(depth.shape[1], depth.shape[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2], fb / K[0, 0])
    return _surface(disparity, rig), labels, true_labels, T


def _seen(folder: Path, seen_as: Appearance, disparity: F32, labels: I16, seed: int) -> tuple[F32, I16]:
    """Disparity and labels in one of the appearances."""
    if seen_as == "true":
        return disparity, labels
    if seen_as == "worn":
        return _worn(disparity, labels, np.random.default_rng(seed))
    measured = np.load(folder / "measured.npz")
    return measured["disparity"], labels if seen_as == "outlined" else measured["ore_map"].astype(np.int16)


def _surface(disparity: F32, rig: Rig) -> Surface:
    z = rig.depth(disparity)
    xyz = rig.back_project(*np.meshgrid(np.arange(rig.width), np.arange(rig.height)), z).astype(np.float32)
    sigma_z = rig.depth_sigma(z, NOISE_PX).astype(np.float32)
    return Surface(xyz, np.zeros((*disparity.shape, 3), np.uint8), sigma_z, 0, 0, rig)


def _worn(disparity: F32, labels: I16, rng: np.random.Generator) -> tuple[F32, I16]:
    """Disparity and labels as measured: outlines fattened and displaced, shadows and holes, noise, most at outlines."""
    fat = int(rng.integers(0, 3))
    disparity = np.asarray(cv2.dilate(disparity, _disc(fat)), np.float32)
    labels = np.asarray(cv2.dilate(labels, _disc(int(rng.integers(0, min(fat, 1) + 1)))), np.int16)
    v, u = np.indices(labels.shape, np.float32)
    du, dv = (SHIFT_PX * _field(rng, labels.shape, SHIFT_REACH_PX) for _ in range(2))
    disparity = np.asarray(cv2.remap(disparity, u + du, v + dv, cv2.INTER_NEAREST), np.float32)
    du, dv = (shift + MISMATCH_PX * _field(rng, labels.shape, SHIFT_REACH_PX) for shift in (du, dv))
    labels = np.asarray(cv2.remap(labels, u + du, v + dv, cv2.INTER_NEAREST), np.int16)
    near = cv2.distanceTransform((cv2.Laplacian(labels.astype(np.float32), -1) == 0).astype(np.uint8), cv2.DIST_L2, 3)
    noise = sum(share * _field(rng, labels.shape, reach) for reach, share in ((1.0, 0.6), (3.0, 0.6), (12.0, 0.5)))
    noise = NOISE_PX * noise * (1.0 + (NOISE_AT_OUTLINE - 1.0) * np.exp(-near / 2.0))
    hole = _occluded(disparity) | (rng.random(labels.shape) < HOLES_AT_OUTLINE * np.exp(-near / 2.0))
    return np.where((disparity > 0) & ~hole, disparity + noise, 0.0).astype(np.float32), labels


def _disc(radius: int) -> U8:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _occluded(disparity: F32) -> Mask:
    """Pixels that something nearer, farther right in the left image, hides from the right eye."""
    column = np.arange(disparity.shape[1]) - disparity
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(leftmost < column - 1.0)


def _field(rng: np.random.Generator, shape: tuple[int, ...], reach_px: float) -> F32:
    """Random field of unit variance, correlated over `reach_px`."""
    field = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), reach_px)
    return np.asarray(field / field.std(), np.float32)


def _bars(truth: Mapping[str, Any], T_left_screen: F64, plane: Plane) -> Bars:
    x = np.array(truth["bar_centres_x_mm"]) / 1000
    across, pitch = T_left_screen[:3, 0], float(x[1] - x[0])
    phase = float(across @ (T_left_screen[:3, 3] + x[0] * across - plane.offset * plane.normal))
    return Bars(T_left_screen[:3, 1], across, pitch, phase % pitch, truth["bar_width_mm"] / 1000)
