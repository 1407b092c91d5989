"""Faults planted in made-up scenes: what the record says, and whether a target is left that an arm would strike."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from stereo_ore import pipeline
from stereo_ore.config import Config
from stereo_ore.errors import StereoOreError
from stereo_ore.lab import synth
from stereo_ore.record import Json
from stereo_ore.runs.batch import frame_lines
from stereo_ore.runs.history import Watch
from stereo_ore.types import F64, U8, CameraModel, Plane, Site, StereoCalibration, StereoPair

OTHER_ZED_BASELINE = 0.063 / 0.12
"""A ZED Mini's file for a ZED 2."""
WIDTH_RATIO = 2208 / 1920
"""What scaling a focal length by the width makes of 2K for 1080p, which is a crop."""


@dataclass(frozen=True)
class Case:
    """What a run is given: frames, the last of which is judged, calibration and site."""

    frames: tuple[StereoPair, ...]
    calibration: StereoCalibration
    site: Site


Fault = Callable[[Case], Case]

SOUND = "none"
"""The name of no fault."""


@dataclass
class Row:
    """What became of a fault over all scenes."""

    fault: str
    frames: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    with_targets: int = 0
    wrong: int = 0

    def add(self, record: Json | None) -> str | None:
        """Add a frame; what is wrong with it: a target in spite of the fault, or a sound frame that was refused."""
        status = "refused" if record is None else record["status"]
        reasons = [] if record is None else sorted({reason["code"] for reason in record["reasons"]})
        targets = 0 if record is None else len(record["targets"])
        self.frames += 1
        self.statuses[status] += 1
        self.codes.update(reasons)
        self.with_targets += targets > 0
        sound = self.fault == SOUND
        if status in ("ok", "empty") if sound else not targets:
            return None
        self.wrong += 1
        return f"{status} {', '.join(reasons)}, {targets} targets"


def _images(change: Callable[[U8, U8], tuple[U8, U8]]) -> Fault:
    def plant(case: Case) -> Case:
        left, right = change(case.frames[-1].left, case.frames[-1].right)
        pair = replace(case.frames[-1], left=np.ascontiguousarray(left), right=np.ascontiguousarray(right))
        return replace(case, frames=(pair,))

    return plant


def _calibration(change: Callable[[StereoCalibration], StereoCalibration]) -> Fault:
    return lambda case: replace(case, calibration=change(case.calibration))


def _scaled_focal(factor: float) -> Fault:
    def scaled(eye: CameraModel) -> CameraModel:
        return replace(eye, focal_px=(factor * eye.focal_px[0], factor * eye.focal_px[1]))

    return _calibration(lambda c: replace(c, left=scaled(c.left), right=scaled(c.right)))


def _right_column(shift_px: float) -> Fault:
    """The principal column of one eye is off: all disparities are."""

    def shifted(c: StereoCalibration) -> StereoCalibration:
        u, v = c.right.principal_point_px
        return replace(c, right=replace(c.right, principal_point_px=(u + shift_px, v)))

    return _calibration(shifted)


def _rotation(change: Callable[[F64], F64]) -> Fault:
    def changed(c: StereoCalibration) -> StereoCalibration:
        vector = np.asarray(cv2.Rodrigues(c.R_right_left)[0], np.float64).ravel()
        return replace(c, R_right_left=np.asarray(cv2.Rodrigues(change(vector))[0], np.float64))

    return _calibration(changed)


def _bumped(turn_deg: tuple[float, float, float], raised: float = 0.0) -> Fault:
    """The camera was turned about its axes, and raised by a share of its height; the site is that of the old pose."""

    def bump(case: Case) -> Case:
        plane = case.site.plane
        assert plane is not None, "made-up sites know the plane"
        T_old_new = np.eye(4)
        T_old_new[:3, :3] = cv2.Rodrigues(np.radians(turn_deg))[0]
        T_old_new[:3, 3] = -plane.offset * raised * plane.normal
        return replace(case, site=moved(case.site, T_old_new))

    return bump


def moved(site: Site, T_old_new: F64) -> Site:
    """The site as it is taken to be in the frame of a camera that has moved since: X_old = T_old_new · X_new."""
    plane, volume, T = site.plane, site.volume, site.T_arm_camera
    if plane is not None:
        offset = plane.offset - float(plane.normal @ T_old_new[:3, 3])
        plane = Plane(T_old_new[:3, :3].T @ plane.normal, offset)
    if volume is not None:
        volume = replace(volume, T_box_camera=volume.T_box_camera @ T_old_new)
    return replace(site, plane=plane, volume=volume, T_arm_camera=None if T is None else T @ T_old_new)


FAULTS: dict[str, Fault] = {
    SOUND: lambda case: case,
    "eyes swapped": _images(lambda left, right: (right, left)),
    "left eye black": _images(lambda left, right: (np.zeros_like(left), right)),
    "right eye black": _images(lambda left, right: (left, np.zeros_like(right))),
    "the same eye twice": _images(lambda left, right: (left, left)),
    "right eye upside down": _images(lambda left, right: (left, right[::-1, ::-1])),
    "right eye 2 rows lower": _images(lambda left, right: (left, np.roll(right, 2, 0))),
    "right eye 6 rows lower": _images(lambda left, right: (left, np.roll(right, 6, 0))),
    "frozen": lambda case: replace(case, frames=(case.frames[-1],) * 2),
    "right column + 1 px": _right_column(1.0),
    "right column − 1 px": _right_column(-1.0),
    "disparity offset + 16 px": _calibration(lambda c: replace(c, disparity_offset_px=16.0)),
    "disparity offset − 16 px": _calibration(lambda c: replace(c, disparity_offset_px=-16.0)),
    "baseline of a ZED Mini": _calibration(lambda c: replace(c, t_right_left=OTHER_ZED_BASELINE * c.t_right_left)),
    "baseline + 10 %": _calibration(lambda c: replace(c, t_right_left=1.1 * c.t_right_left)),
    "baseline − 10 %": _calibration(lambda c: replace(c, t_right_left=0.9 * c.t_right_left)),
    "baseline in millimetres": _calibration(lambda c: replace(c, t_right_left=1000 * c.t_right_left)),
    "focal length by the width": _scaled_focal(WIDTH_RATIO),
    "focal length by the width, inverse": _scaled_focal(1 / WIDTH_RATIO),
    "camera pitched by 5°": _bumped((5, 0, 0)),
    "camera yawed by 5°": _bumped((0, 5, 0)),
    "camera raised by 10 %": _bumped((0, 0, 0), 0.1),
    "camera lowered by 10 %": _bumped((0, 0, 0), -0.1),
}  # fmt: skip
"""Faults of a scene with rectified images."""

RAW_FAULTS: dict[str, Fault] = {
    SOUND: lambda case: case,
    "rotation ignored": _rotation(lambda v: 0 * v),
    "rotation transposed": _rotation(lambda v: -v),
    "convergence (CV) off by 0.4°": _rotation(lambda v: v + np.radians([0, 0.4, 0])),
    "lenses exchanged": _calibration(lambda c: replace(c, left=c.right, right=c.left)),
    "taken for rectified": _calibration(lambda c: replace(c, images="rectified", R_right_left=np.eye(3),
        left=replace(c.left, distortion=()), right=replace(c.left, distortion=()))),
}  # fmt: skip
"""Misreadings of the calibration of raw images."""


def judge(case: Case, config: Config) -> Json | None:
    """The record of the last frame; None where the run is refused before the first."""
    try:
        context = pipeline.make_context(case.calibration, case.site, config)
    except StereoOreError:
        return None
    watch = Watch(config.health)
    record: Json | None = None
    for index, pair in enumerate(case.frames):
        lines = frame_lines(pipeline.process(replace(pair, index=index), context), case.site, [])
        record = json.loads(watch.judge(lines).record)
    return record


def plant(scene: synth.Scene, config: Config) -> Iterator[tuple[str, Json | None]]:
    """Each fault in a scene, with the record that comes of it."""
    case = Case((scene.pair,), scene.calibration, scene.site)
    for name, fault in (RAW_FAULTS if scene.spec.raw else FAULTS).items():
        yield name, judge(fault(case), config)


def markdown(rows: Sequence[Row]) -> str:
    """A line a fault."""
    head = "| fault | frames | ok | degraded | empty | failed | refused | frames with targets | told by |"
    lines = [head, "|---" * 9 + "|"]
    for row in rows:
        cells = [row.statuses[name] or "" for name in ("ok", "degraded", "empty", "failed", "refused")]
        told = ", ".join(f"{code} {times}" for code, times in row.codes.most_common())
        lines.append("| " + " | ".join(map(str, (row.fault, row.frames, *cells, row.with_targets, told))) + " |")
    return "\n".join(lines) + "\n"
