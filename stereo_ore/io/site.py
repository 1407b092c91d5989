"""The site file: where the camera looks, the arm, the grizzly; brought into the camera frame."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from stereo_ore.config.validation import validate
from stereo_ore.errors import ConfigError
from stereo_ore.io import keep_out as places
from stereo_ore.io.posture import posture_document
from stereo_ore.io.site_sections import (
    FORMAT,
    BarSection,
    HandEyeRecord,
    PlaneSection,
    SiteFile,
    SurveyRecord,
    entry_faults,
)
from stereo_ore.io.yaml_io import load_yaml
from stereo_ore.transforms import inverse, nearest_rotation, rotate, rotation_fault
from stereo_ore.types import F64, BarLine, Plane, Site, Survey, Volume

_log = logging.getLogger(__name__)

_BAR_OFF_M = 0.5
"""A bar's point may lie so far from the plane of the bar tops."""


def load_site(path: str | Path) -> Site:
    """The site in a YAML file, with plane and volume in the camera frame.

    Raises
    ------
    ConfigError
        With all faults of the file at once: unknown keys with the nearest valid one, a transform
        that is none, a box that is empty or behind the camera, a plane behind the camera or away
        from the box.
    """
    path = Path(path)
    file = validate(SiteFile, load_yaml(path, ConfigError), path, ConfigError)
    faults = entry_faults(file)
    site = None if faults else _site(file, path)
    faults = faults or _view_faults(site)
    if faults or site is None:
        raise ConfigError(
            faults[0] if len(faults) == 1 else f"{len(faults)} faults:\n  " + "\n  ".join(faults),
            file=path,
        )
    if file.tool_from_camera is not None and file.arm_from_camera is None:
        _log.warning(
            "%s: the camera is on the tool and moves with the arm: no arm coordinates", path
        )
    return site


def _site(file: SiteFile, path: Path) -> Site:
    T_arm_camera = None if file.arm_from_camera is None else _rigid(np.array(file.arm_from_camera))
    grizzly, box, reach = file.grizzly, file.working_volume, file.reach
    screen = file.screen_from_camera
    T_screen_camera = None if screen is None else _rigid(np.array(screen))
    return Site(
        T_arm_camera=T_arm_camera,
        volume=None
        if box is None
        else Volume(
            _to(box.frame, T_screen_camera if box.frame == "screen" else T_arm_camera),
            np.array(box.min_m),
            np.array(box.max_m),
        ),
        plane=None if grizzly.plane is None else _camera_plane(grizzly.plane, T_arm_camera),
        opening_m=grizzly.openings_m[0] if grizzly.openings_m else grizzly.opening_m,
        cross_opening_m=grizzly.openings_m[1] if grizzly.openings_m else None,
        bar_profile=grizzly.bar_profile,
        bar_width_m=grizzly.bar_width_m,
        background=None if file.background is None else path.parent / file.background,
        reach_min_m=None if reach is None else np.array(reach.min_m),
        reach_max_m=None if reach is None else np.array(reach.max_m),
        survey=_survey(file.survey),
        keep_out=tuple(places.in_camera(entry, T_arm_camera) for entry in file.keep_out),
        posture=file.posture.link(path.parent) if file.posture else None,
        bar=None if grizzly.bar is None else _camera_bar(grizzly.bar, T_arm_camera),
    )


def _rigid(T: F64) -> F64:
    """The transform with an exact rotation; one that is exact stays as it is, to the last bit."""
    if rotation_fault(T[:3, :3], 1e-9):
        T[:3, :3] = nearest_rotation(T[:3, :3])
    return T


def _survey(record: SurveyRecord | None) -> Survey | None:
    if record is None:
        return None
    return Survey(record.calibration, record.camera, record.image_size, record.confirmed)


def _to(frame: str, T_frame_camera: F64 | None) -> F64:
    """``T_frame_camera``, of the camera itself none is given."""
    return np.eye(4) if frame == "camera" or T_frame_camera is None else T_frame_camera


def _camera_plane(plane: PlaneSection, T_arm_camera: F64 | None) -> Plane:
    """The plane in the camera frame: unit normal, towards the camera (the origin)."""
    T = _to(plane.frame, T_arm_camera)
    length = float(np.linalg.norm(plane.normal))
    length = 1.0 if abs(length - 1) < 1e-9 else length  # a unit normal stays as it is written
    normal, offset = np.array(plane.normal) / length, plane.offset_m / length
    offset -= float(normal @ T[:3, 3])
    normal = rotate(inverse(T), normal)
    return Plane(-normal, -offset) if offset > 0 else Plane(normal, offset)


def _camera_bar(bar: BarSection, T_arm_camera: F64 | None) -> BarLine:
    direction = np.array(bar.direction) / np.linalg.norm(bar.direction)
    return BarLine(np.array(bar.point_m), direction).seen_from(_to(bar.frame, T_arm_camera))


def _view_faults(site: Site | None) -> list[str]:
    """What the camera can't see."""
    found: list[str] = []
    if site is None:
        return found
    if site.plane is not None and site.plane.normal[2] >= 0:
        found.append(
            "grizzly.plane: lies behind the camera; check the sign of offset_m, and arm_from_camera"
        )
    if site.bar is not None and site.plane is not None:
        height = float(site.plane.height(site.bar.point))
        if abs(height) > _BAR_OFF_M:
            side = "above" if height > 0 else "below"
            found.append(
                f"grizzly.bar.point_m: lies {1000 * abs(height):.0f} mm {side} grizzly.plane, the"
                " bar tops"
            )
    if site.volume is not None:
        corners = site.volume.corners
        if corners[:, 2].max() <= 0:
            found.append(
                "working_volume: lies behind the camera; check arm_from_camera and the frame"
            )
        elif site.plane is not None and site.plane.height(corners).max() < 0:
            found.append(
                "working_volume: lies below the plane of the bar tops; check grizzly.plane"
            )
    return found


def save_site(
    site: Site,
    path: str | Path,
    hand_eye: HandEyeRecord | None = None,
    survey: SurveyRecord | None = None,
) -> None:
    """Write a site file that `load_site` reads back as the same site.

    The plane is written in the camera frame, the volume in the frame of its box: the camera's, the
    arm's, or one of its own, which is then called the screen's.
    """
    path = Path(path)
    document: dict[str, Any] = {"format": FORMAT, "version": 1}
    if site.T_arm_camera is not None:
        document["arm_from_camera"] = site.T_arm_camera.tolist()
    if site.volume is not None:
        frame = _frame_of(site, site.volume)
        if frame == "screen":
            document["screen_from_camera"] = site.volume.T_box_camera.tolist()
        document["working_volume"] = {"frame": frame} | _box(site.volume.min_m, site.volume.max_m)
    document["grizzly"] = _grizzly(site)
    if site.background is not None:
        document["background"] = _relative(site.background, path.parent)
    if site.reach_min_m is not None and site.reach_max_m is not None:
        document["reach"] = _box(site.reach_min_m, site.reach_max_m)
    if site.keep_out:
        document["keep_out"] = [places.document(place) for place in site.keep_out]
    if link := site.posture:
        file = None if link.file is None else _relative(link.file, path.parent)
        document["posture"] = posture_document(link, file)
    for key, record in (("hand_eye", hand_eye), ("survey", survey)):
        if record is not None:
            document[key] = record.model_dump(mode="json")
    path.write_text(
        yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120),
        encoding="utf-8",
    )


def save_arm(
    T_arm_camera: F64,
    hand_eye: HandEyeRecord,
    path: str | Path,
    base: str | Path | None = None,
    mount: Literal["fixed", "tool"] = "fixed",
) -> None:
    """Write a site file with a new `arm_from_camera`; the rest is that of `base`, or unknown.

    What `base` gives in the arm frame stays where it is in the arm frame. Of a camera on the tool
    (`mount`), the transform is ``T_tool_camera``, which moves with the arm: it is kept under
    `tool_from_camera`, and the site has no `arm_from_camera`.

    Raises
    ------
    ConfigError
        When `base` is no site file, or does not fit the new transform.
    """
    path = Path(path)
    document = {"format": FORMAT, "version": 1}
    if base is not None:
        document = load_yaml(Path(base), ConfigError)
        validate(SiteFile, document, base, ConfigError)
    document.pop("arm_from_camera", None)
    document.pop("tool_from_camera", None)
    key = "arm_from_camera" if mount == "fixed" else "tool_from_camera"
    document |= {key: T_arm_camera.tolist(), "hand_eye": hand_eye.model_dump(mode="json")}
    file = validate(SiteFile, document, path, ConfigError)
    if faults := entry_faults(file) or _view_faults(_site(file, path)):
        raise ConfigError(
            "; ".join(faults),
            file=base,
            remedy="Was the calibration made with this arm and camera?",
        )
    path.write_text(
        yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120),
        encoding="utf-8",
    )


def _grizzly(site: Site) -> dict[str, Any]:
    sizes = {"opening_m": site.opening_m, "bar_width_m": site.bar_width_m}
    section: dict[str, Any] = {key: value for key, value in sizes.items() if value is not None}
    if site.cross_opening_m is not None:
        section["openings_m"] = [section.pop("opening_m"), site.cross_opening_m]
    if site.bar_profile != "flat":
        section["bar_profile"] = site.bar_profile
    plane = site.plane
    section["plane"] = (
        "auto"
        if plane is None
        else {"frame": "camera", "normal": plane.normal.tolist(), "offset_m": plane.offset}
    )
    if (bar := site.bar) is not None:
        place = {"point_m": bar.point.tolist(), "direction": bar.direction.tolist()}
        section["bar"] = {"frame": "camera"} | place
    return section


def _box(low: F64, high: F64) -> dict[str, Any]:
    return {"min_m": low.tolist(), "max_m": high.tolist()}


def _relative(file: Path, folder: Path) -> str:
    """The path as seen from the site file, so that both can move together."""
    absolute, base = file.resolve(), folder.resolve()
    return str(absolute.relative_to(base) if absolute.is_relative_to(base) else absolute)


def _frame_of(site: Site, volume: Volume) -> str:
    T = volume.T_box_camera
    if np.array_equal(T, np.eye(4)):
        return "camera"
    if site.T_arm_camera is not None and np.array_equal(T, site.T_arm_camera):
        return "arm"
    return "screen"
