"""Stereo pairs with true disparities: Middlebury v3 and 2006, the aloe, and path-traced or
synthetic scenes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.errors import SourceError
from stereo_ore.io import calibration, recordings
from stereo_ore.lab import evaluate
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.stages import matching, rectify
from stereo_ore.types import F32, U8, Mask, RectifiedPair, Region, Rig, Volume

MIDDLEBURY_2006_SCALE = 3.0
"""Its truth images at a third of the size hold three times the disparity."""


@dataclass(frozen=True)
class StereoSet:
    """A pair with truth (H, W) float32 [px], NaN = unknown.

    `seen` are the pixels that both eyes see, None where that is not known; `ore` the pixels of
    lumps, None where there are none. `region` is what any matcher may search, `volume` what our own
    is also told.
    """

    name: str
    pair: RectifiedPair
    truth: F32
    region: Region
    seen: Mask | None = None
    ore: Mask | None = None
    volume: Volume | None = None


def find_sets(folder: Path) -> Iterator[StereoSet]:
    """All sets in a folder and below it, by name.

    Raises
    ------
    SourceError
        When there is none, or a file of one can't be read.
    """
    readers = {
        "disp0GT.pfm": middlebury,
        "disp1.png": middlebury_2006,
        "aloeGT.png": aloe,
        "gt.npz": traced_sets,
    }
    found = sorted(
        (path.parent, reader) for name, reader in readers.items() for path in folder.rglob(name)
    )
    if not found:
        remedy = "Give a folder of Middlebury sets or of scene folders with gt.npz"
        raise SourceError("holds no stereo pair with truth", file=folder, remedy=remedy)
    for parent, reader in found:
        yield reader(parent)


def middlebury(folder: Path) -> StereoSet:
    """A Middlebury v3 set; unknown truth is infinite."""
    rig = rectify.make_rectifier(calibration.load(folder / "calib.txt")).rig
    truth = read_pfm(folder / "disp0GT.pfm")
    mask = folder / "mask0nocc.png"
    seen = np.asarray(_image(mask, cv2.IMREAD_GRAYSCALE) == 255) if mask.exists() else None
    pair = RectifiedPair(_image(folder / "im0.png"), _image(folder / "im1.png"), rig)
    return _whole(
        folder.name,
        pair,
        np.where(np.isfinite(truth) & (truth > 0), truth, np.float32(np.nan)),
        seen,
    )


def middlebury_2006(folder: Path) -> StereoSet:
    """A third-size Middlebury 2006 set; unknown truth is 0."""
    left, right = _image(folder / "view1.png"), _image(folder / "view5.png")
    truth = _image(folder / "disp1.png", cv2.IMREAD_GRAYSCALE).astype(np.float32) / np.float32(
        MIDDLEBURY_2006_SCALE
    )
    return _whole(
        folder.name, RectifiedPair(left, right, _bare_rig(left)), np.where(truth > 0, truth, np.nan)
    )


def aloe(folder: Path) -> StereoSet:
    """OpenCV's aloe; unknown truth is 0."""
    left, right = _image(folder / "aloeL.jpg"), _image(folder / "aloeR.jpg")
    truth = _image(folder / "aloeGT.png", cv2.IMREAD_GRAYSCALE).astype(np.float32)
    return _whole(
        folder.name, RectifiedPair(left, right, _bare_rig(left)), np.where(truth > 0, truth, np.nan)
    )


def traced_sets(folder: Path) -> StereoSet:
    """A scene folder with calibration, working volume and exact truth; what lies outside the volume
    does not count.
    """
    truth = evaluate.load_truth(folder)
    stereo, site = load_rig(folder)
    pair = rectify.rectify(recordings.open_source(folder).read(0), rectify.make_rectifier(stereo))
    known = truth.depth > 0
    if site.volume is not None:
        v, u = np.indices(truth.depth.shape)
        known &= site.volume.contains(pair.rig.back_project(u, v, truth.depth))
    disparity = np.where(known, truth.disparity, np.nan).astype(np.float32)
    region = matching.find_region(pair.rig, site.volume, MatchingConfig())
    return StereoSet(
        folder.name,
        pair,
        disparity,
        region,
        ore=np.asarray(truth.instance >= 2),
        volume=site.volume,
    )


def read_pfm(path: Path) -> F32:
    """A grey PFM image (H, W), top row first.

    Raises
    ------
    SourceError
        When the file is absent, of another kind, or too short.
    """
    try:
        with path.open("rb") as file:
            kind, size, scale = (file.readline().strip() for _ in range(3))
            width, height = (int(word) for word in size.split())
            order = "<f4" if float(scale) < 0 else ">f4"
            values = np.frombuffer(file.read(), order)
        if kind != b"Pf":
            raise ValueError(
                f"kind {kind.decode(errors='replace')!r}, only grey ones (Pf) are read"
            )
        return np.ascontiguousarray(values.reshape(height, width)[::-1], np.float32)
    except OSError as fault:
        raise SourceError(f"can't be read: {fault.strerror}", file=path) from None
    except ValueError as fault:
        raise SourceError(f"is not a PFM image: {fault}", file=path) from None


def _whole(name: str, pair: RectifiedPair, truth: F32, seen: Mask | None = None) -> StereoSet:
    """A set searched over the whole image, from 0 to just above the largest true disparity."""
    count = 16 * math.ceil((float(np.nanmax(truth)) + 2) / 16)
    region = Region(0, 0, pair.rig.width, pair.rig.height, 0, count)
    return StereoSet(name, pair, truth.astype(np.float32), region, seen)


def _bare_rig(image: U8) -> Rig:
    """Disparities only: no metric scale came with the pair."""
    height, width = image.shape[:2]
    return Rig(width, height, float(width), float(width), width / 2, height / 2, 0.1)


def _image(path: Path, flags: int = cv2.IMREAD_COLOR) -> U8:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise SourceError("can't be read as an image", file=path)
    return np.asarray(image, np.uint8)
