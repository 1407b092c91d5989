"""Fit the coefficients of `stereo_ore.solid.prior` to scenes whose truth is known.

    python -m stereo_ore.solid.fit OUT.json SCENES_DIR[*WEIGHT]…

A scene is a folder with calib.json, gt.json and gt.npz, as `stereo-ore synth` writes them. Every scene is used twice,
with its exact depth and with noise like that of a matcher.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import find_objects

from stereo_ore.solid.cues import gather
from stereo_ore.solid.prior import DOUBTS, TARGETS
from stereo_ore.solid.sight import look
from stereo_ore.types import F64, I16, Bars, Plane, Rig, Surface

FIRST_LUMP = 2
MIN_PIXELS, MIN_VISIBLE = 400, 0.3
NOISE_PX = 0.15
"""Standard deviation of the disparity noise added to the second copy of a scene."""
RIDGE, RIDGE_ODD = 100.0, 0.03
FOLDS = 5


@dataclass(frozen=True)
class Sample:
    """A lump: its cues, doubts and truth (as `TARGETS` and y), the weight and fold of its scene."""

    even: Mapping[str, float]
    odd: Mapping[str, float]
    doubts: Mapping[str, float]
    truth: Mapping[str, float]
    weight: float
    fold: int


def samples(folder: Path, noise_px: float, weight: float, fold: int) -> Iterator[Sample]:
    """The lumps of a scene that are seen well enough to be judged."""
    truth = json.loads((folder / "gt.json").read_text(encoding="utf-8"))
    surface, labels, T_left_screen = _surface(folder, noise_px, fold)
    plane = Plane(T_left_screen[:3, 2], float(T_left_screen[:3, 2] @ T_left_screen[:3, 3]))
    bars, opening = _bars(truth, T_left_screen, plane), truth["clear_opening_mm"] / 1000
    boxes = find_objects(labels)
    for lump in truth["lumps"]:
        number = lump["id"] - FIRST_LUMP + 1
        seen = lump["visible_pixels"] >= MIN_PIXELS and lump["visible_fraction"] >= MIN_VISIBLE
        if not seen or lump["cut_by_image_border"] or number > len(boxes) or boxes[number - 1] is None:
            continue
        sight = look(surface, labels, boxes[number - 1], number, plane, MIN_PIXELS // 4)
        cues = gather(sight, bars, opening) if sight else None
        if sight is None or cues is None:
            continue
        centre = np.array(lump.get("com_left_rect_mm", lump["com_left_mm"])) / 1000
        local = sight.axes @ (centre - sight.origin) / sight.size
        sizes = np.array([lump["max_caliper_mm"], *lump["obb_dims_mm"][1:]]) / 1000 / sight.size
        target = (local[0], local[2], np.log(lump["volume_mm3"] * 1e-9 / sight.size**3), *np.log(sizes))
        found = dict(zip(TARGETS, map(float, target), strict=True)) | {"y": float(local[1])}
        yield Sample(cues.even, cues.odd, cues.doubts, found, weight, fold)


def _surface(folder: Path, noise_px: float, seed: int) -> tuple[Surface, I16, F64]:
    """True surface, with noise, the lumps' labels and the screen's pose of a scene folder."""
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
    h, w = depth.shape
    rig = Rig(w, h, K[0, 0], K[1, 1], K[0, 2], K[1, 2], fb / K[0, 0])
    disparity = np.where(depth > 0, fb / np.maximum(depth, 1e-6), np.nan) + _noise((h, w), noise_px, seed)
    z = rig.depth(disparity)
    xyz = rig.back_project(*np.meshgrid(np.arange(w), np.arange(h)), z).astype(np.float32)
    sigma_z = rig.depth_sigma(z, NOISE_PX).astype(np.float32)
    labels = np.maximum(instance.astype(np.int16) - FIRST_LUMP + 1, 0).astype(np.int16)
    return Surface(xyz, np.zeros((h, w, 3), np.uint8), sigma_z, 0, 0, rig), labels, T


def _noise(shape: tuple[int, int], sigma_px: float, seed: int) -> F64:
    """Disparity noise of a matcher: correlated over 1, 3 and 12 pixels, `sigma_px` in all."""
    rng, total = np.random.default_rng(seed), np.zeros(shape)
    for reach, share in ((1.0, 0.6), (3.0, 0.6), (12.0, 0.5)):
        field = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), reach)
        total += share * field / field.std()
    return sigma_px * total


def _bars(truth: Mapping[str, Any], T_left_screen: F64, plane: Plane) -> Bars:
    x = np.array(truth["bar_centres_x_mm"]) / 1000
    across, pitch = T_left_screen[:3, 0], float(x[1] - x[0])
    phase = float(across @ (T_left_screen[:3, 3] + x[0] * across - plane.offset * plane.normal))
    return Bars(T_left_screen[:3, 1], across, pitch, phase % pitch, truth["bar_width_mm"] / 1000)


def fit(found: Sequence[Sample]) -> dict[str, Any]:
    """Coefficients as the document that `prior.load` reads; errors are those of folds left out."""
    residuals = {name: np.zeros(len(found)) for name in (*TARGETS, "y")}
    fold = np.array([sample.fold for sample in found]) % FOLDS
    for k in range(FOLDS):
        model = _ridge([s for s, f in zip(found, fold, strict=True) if f != k])
        for i in np.nonzero(fold == k)[0].tolist():
            for name, value in _predict(model, found[i]).items():
                residuals[name][i] = value - found[i].truth[name]
    return _ridge(found) | {"sigma": {name: _spread(found, error) for name, error in residuals.items()}}


def _ridge(found: Sequence[Sample]) -> dict[str, Any]:
    """Weighted ridge regression on standardised even cues, and one without constant on the odd ones."""
    names, odd_names = list(found[0].even), list(found[0].odd)
    w = np.array([s.weight for s in found])
    X, Z = (np.array([[getattr(s, kind)[n] for n in keys] for s in found]) for kind, keys in
            (("even", names), ("odd", odd_names)))  # fmt: skip
    Y = np.array([[s.truth[t] for t in TARGETS] for s in found])
    mean, scale, middle = np.average(X, 0, w), X.std(0) + 1e-9, np.average(Y, 0, w)
    S = (X - mean) / scale
    weights = np.linalg.solve(S.T @ (w[:, None] * S) + RIDGE * np.eye(len(names)), S.T @ (w[:, None] * (Y - middle)))
    y = np.array([s.truth["y"] for s in found])
    odd = np.linalg.solve(Z.T @ (w[:, None] * Z) + RIDGE_ODD * np.eye(len(odd_names)), Z.T @ (w * y))
    return {
        "constant": dict(zip(TARGETS, middle.round(5).tolist(), strict=True)),
        "even": {
            n: {"mean": round(m, 5), "scale": round(s, 5)} | dict(zip(TARGETS, row.round(5).tolist(), strict=True))
            for n, m, s, row in zip(names, mean.tolist(), scale.tolist(), weights, strict=True)
        },
        "odd": dict(zip(odd_names, odd.round(5).tolist(), strict=True)),
    }


def _predict(model: Mapping[str, Any], sample: Sample) -> dict[str, float]:
    cues = [(v, np.clip((sample.even[n] - v["mean"]) / v["scale"], -4, 4)) for n, v in model["even"].items()]
    found = {t: float(model["constant"][t] + sum(v[t] * x for v, x in cues)) for t in TARGETS}
    return found | {"y": sum(weight * sample.odd[n] for n, weight in model["odd"].items())}


def _spread(found: Sequence[Sample], error: F64) -> dict[str, float]:
    """Log-linear model of an error's standard deviation, raised until two of them hold 95 % of the errors."""
    w = np.array([s.weight for s in found])
    D = np.array([[1.0, *(min(s.doubts[d], 1.0) for d in DOUBTS)] for s in found])
    target = np.log(np.abs(error) + 0.1 * np.abs(error).mean())
    row = np.linalg.solve(D.T @ (w[:, None] * D) + np.diag([0.0, *[1.0] * len(DOUBTS)]), D.T @ (w * target))
    ratio = np.abs(error) / np.exp(D @ row)
    order = np.argsort(ratio)
    held = np.cumsum(w[order]) / w.sum()
    row[0] += np.log(ratio[order][np.searchsorted(held, 0.95)] / 2.0)
    return dict(zip(("constant", *DOUBTS), row.round(4).tolist(), strict=True))


def main(arguments: Sequence[str]) -> None:
    """Read the scenes named on the command line, fit, and write the coefficients."""
    found: list[Sample] = []
    for argument in arguments[1:]:
        name, _, weight = argument.partition("*")
        for fold, file in enumerate(sorted(Path(name).glob("*/gt.json"))):
            for noise_px in (0.0, NOISE_PX):
                found += samples(file.parent, noise_px, float(weight or 1), fold)
    text = json.dumps({"lumps": len(found)} | fit(found), indent=None, separators=(", ", ": "))
    Path(arguments[0]).write_text(text.replace("}, ", "},\n  ") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
