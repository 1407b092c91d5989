"""ZED factory files ``SN<serial>.conf``: INI, one section an eye and resolution, millimetres.

X_right = R·X_left + T with T = (−Baseline, TY, TZ) and R = Rodrigues(RX, CV, RZ).
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path

from stereo_ore.config.validation import nearest_word
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import Hints, Projection, tell_unread, without_tail
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.types import CameraModel, StereoCalibration

ZED_SIZES = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""Width and height of one eye in each mode."""

_SECTION = re.compile(r"^[ \t]*\[(LEFT|RIGHT)_CAM_\w+\]", re.MULTILINE | re.IGNORECASE)
_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_CAMERA = ("fx", "fy", "cx", "cy")
_STEREO = re.compile(r"(baseline|ty|tz|cv|rx|ry|rz)(_\w+)?")

Values = dict[str, float]


def recognises(text: str) -> bool:
    """Whether the text has a section of a ZED eye."""
    return bool(_SECTION.search(text))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration of the mode whose images have `hints.image_size`.

    Raises
    ------
    CalibrationError
        When the size is not given, is no ZED mode or not in the file; when a key is missing or no
        number.
    """
    sections = _parse(path, text)
    mode = _mode(path, sections, hints.image_size or hints.recorded_size)
    if hints.images == "rectified":
        raise CalibrationError(
            "a factory file describes the raw images, not the rectified ones that the ZED SDK"
            " writes",
            file=path,
            remedy=(
                "Take fx, cx, cy and the baseline from the SDK (calibration_parameters) into a"
                " native YAML"
            ),
        )
    eyes = {side: _eye(path, sections, side, mode) for side in ("left", "right")}
    stereo = sections.get("stereo", {})
    tell_unread(
        path,
        {key: value for key, value in stereo.items() if not _STEREO.fullmatch(key)},
        "[STEREO] ",
    )
    rotation = [_stereo(path, stereo, names, mode) for names in (("rx",), ("cv", "ry"), ("rz",))]
    baseline = _require(path, stereo, "baseline", "STEREO")
    shift = [_stereo(path, stereo, (name,), mode, missing=0.0) for name in ("ty", "tz")]
    return make_calibration(
        path,
        image_size=ZED_SIZES[mode],
        left=eyes["left"],
        right=eyes["right"],
        rotation=rotation,
        translation_m=[round(value / 1000, 12) for value in (-baseline, *shift)],
        images="raw",
        camera=f"ZED {path.stem} {mode}",
    )


def _parse(path: Path, text: str) -> dict[str, Values]:
    """Sections and keys in lower case, values as numbers; text values are left out."""
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";", "#"))
    try:
        parser.read_string(text)
    except configparser.Error as fault:
        raise CalibrationError(
            f"is not a valid INI file: {str(fault).splitlines()[0]}", file=path
        ) from None
    return {name.lower(): _numbers(path, name, parser[name]) for name in parser.sections()}


def _numbers(path: Path, section: str, items: configparser.SectionProxy) -> Values:
    values = {}
    for key, text in items.items():
        try:
            values[key.lower()] = float(text)
        except (TypeError, ValueError):
            if section.upper() == "STEREO" or "_CAM_" in section.upper():
                raise CalibrationError(
                    f"{text!r} is not a number", file=path, key=f"[{section}] {key}"
                ) from None
    return values


def _mode(path: Path, sections: dict[str, Values], size: tuple[int, int] | None) -> str:
    present = [mode for mode in ZED_SIZES if f"left_cam_{mode}".lower() in sections]
    names = ", ".join(f"{mode} ({ZED_SIZES[mode][0]}×{ZED_SIZES[mode][1]})" for mode in present)
    if size is None and len(present) == 1:
        return present[0]
    if size is None:
        raise CalibrationError(
            f"holds several resolutions: {names}", file=path, remedy="Say which with --size WxH"
        )
    for mode in present:
        if ZED_SIZES[mode] == tuple(size):
            return mode
    raise CalibrationError(
        f"has no calibration for images of {size[0]}×{size[1]} px, only {names or 'none'}",
        file=path,
    )


def _require(path: Path, values: Values, key: str, section: str) -> float:
    if key in values:
        return values[key]
    raise CalibrationError(
        f"key is missing{nearest_word(key, values)}", file=path, key=f"[{section}] {key}"
    )


def _eye(path: Path, sections: dict[str, Values], side: str, mode: str) -> CameraModel:
    name = f"{side}_cam_{mode}"
    values = sections.get(name.lower())
    if values is None:
        raise CalibrationError("section is missing", file=path, key=f"[{name.upper()}]")
    fx, fy, cx, cy = (_require(path, values, key, name.upper()) for key in ("fx", "fy", "cx", "cy"))
    lens = _lens(path, values, sections.get(f"{side}_disto", {}), side)
    return CameraModel((fx, fy), (cx, cy), *lens)


def _lens(
    path: Path, narrow: Values, wide: Values, side: str
) -> tuple[tuple[float, ...], Projection]:
    """Coefficients and projection, from the mode's own section or from ``[LEFT_DISTO]`` of newer
    files.

    k1…k4 without p1 and p2 are those of a fisheye lens (Kannala-Brandt); with them, up to twelve of
    OpenCV's.
    """
    for name, section in ((f"{side} eye: ", narrow), (f"[{side.upper()}_DISTO] ", wide)):
        tell_unread(
            path,
            {key: v for key, v in section.items() if key not in (*_CAMERA, *_DISTORTION)},
            name,
        )
    own, common = (
        {key: part[key] for key in _DISTORTION if key in part} for part in (narrow, wide)
    )
    if any(own.values()) and any(common.values()) and {**own, **common} != {**common, **own}:
        problem = f"gives the {side} lens two sets of coefficients that differ"
        raise CalibrationError(problem, file=path, key=f"[{side.upper()}_DISTO]")
    found = common | own if any(own.values()) or not common else own | common
    if "k4" in found and not {"p1", "p2", "k5", "k6"} & found.keys():
        return tuple(found.get(key, 0.0) for key in ("k1", "k2", "k3", "k4")), "equidistant"
    keep = 8 if "k4" in found else 5
    return without_tail((found.get(key, 0.0) for key in _DISTORTION), keep), "pinhole"


def _stereo(
    path: Path, stereo: Values, names: tuple[str, ...], mode: str, missing: float | None = None
) -> float:
    """A value of [STEREO], spelled with the mode's suffix or without it."""
    for key in (spelling for name in names for spelling in (f"{name}_{mode}".lower(), name)):
        if key in stereo:
            return stereo[key]
    if missing is not None:
        return missing
    return _require(path, stereo, f"{names[0]}_{mode}".lower(), "STEREO")
