"""Luxonis depthai's JSON: intrinsics a socket, and a chain of transforms X_to = R·X_from + t from
socket to socket.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    parse_json,
    raw_only,
    tell_unread,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.transforms import inverse, nearest_rotation, rotation_fault
from stereo_ore.types import F64, CameraModel, StereoCalibration

LENGTHS_M = (1.0, 0.01, 0.001, 0.0254, 0.3048)
"""Metres a unit of `lengthUnit`: metre, centimetre (also where it is not said), millimetre, inch,
foot."""

ROUNDED = 1e-5
"""The device keeps 32 bits of each number."""

_CAMERA = (
    "cameraType", "distortionCoeff", "extrinsics", "height", "intrinsicMatrix", "lensPosition",
    "specHfovDeg", "width"
)  # fmt: skip
_TOP = re.compile(
    r"cameraData|stereoRectificationData|stereoUseSpecTranslation|stereoEnableDistortionCorrection|imu\w*|housing\w*|"
    r"(batch|board|device|product|hardware|version|miscellaneous|vertical)\w*"
)

Sockets = dict[int, dict[str, Any]]


def recognises(text: str) -> bool:
    """Whether the text has depthai's names."""
    return text.lstrip().startswith("{") and '"cameraData"' in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration of the stereo pair that the file names, or of `hints.eyes` (numbers of
    sockets).

    Raises
    ------
    CalibrationError
        When a socket or the transform between both is missing; when a lens is neither perspective
        nor fisheye.
    """
    data = parse_json(path, text)
    raw_only(path, hints)
    tell_unread(path, {key: value for key, value in data.items() if not _TOP.fullmatch(key)})
    sockets = _sockets(path, data.get("cameraData"))
    left, right = hints.eyes or _pair(path, data, sockets)
    for socket in (left, right):
        if socket not in sockets:
            raise CalibrationError(
                f"has no camera at socket {socket}, only {sorted(sockets)}", file=path
            )
    T = _between(path, sockets, left, right)
    size = one_size(
        path, [[sockets[i].get("width"), sockets[i].get("height")] for i in (left, right)], hints
    )
    return make_calibration(
        path,
        image_size=size,
        left=_camera(path, left, sockets[left]),
        right=_camera(path, right, sockets[right]),
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=(
            f"{data.get('productName') or data.get('boardName') or path.stem} sockets {left},"
            f" {right}"
        ),
    )


def _sockets(path: Path, entries: Any) -> Sockets:
    pairs = entries if isinstance(entries, list) else []
    found = {pair[0]: pair[1] for pair in pairs if isinstance(pair, list) and len(pair) == 2}
    if not found or not all(isinstance(k, int) and isinstance(v, dict) for k, v in found.items()):
        raise CalibrationError("must be a list of [socket, camera]", file=path, key="cameraData")
    return found


def _pair(path: Path, data: dict[str, Any], sockets: Sockets) -> tuple[int, int]:
    stereo = data.get("stereoRectificationData")
    stereo = stereo if isinstance(stereo, dict) else {}
    pair = tuple(stereo.get(f"{side}CameraSocket", -1) for side in ("left", "right"))
    if not all(socket in sockets for socket in pair):
        remedy = "Say which are left and right with --eyes L,R"
        raise CalibrationError(
            f"names no stereo pair of its sockets {sorted(sockets)}", file=path, remedy=remedy
        )
    return pair[0], pair[1]


def _between(path: Path, sockets: Sockets, left: int, right: int) -> F64:
    """``T_right_left`` along the links, each taken in either direction."""
    steps = {(a, b): T for a, camera in sockets.items() for b, T in _link(path, a, camera)}
    reached, border = {left: np.eye(4)}, [left]
    while border:
        at = border.pop()
        for (a, b), T in steps.items():
            for source, target, step in ((a, b, T), (b, a, inverse(T))):
                if source == at and target not in reached:
                    reached[target] = step @ reached[at]
                    border.append(target)
    if right not in reached:
        raise CalibrationError(
            f"no extrinsics lead from socket {left} to {right}", file=path, key="extrinsics"
        )
    return reached[right]


def _link(path: Path, socket: int, camera: dict[str, Any]) -> Iterator[tuple[int, F64]]:
    """The socket that a camera refers to, and ``T_to_from`` [m]; the last of a chain has none."""
    extrinsics = camera.get("extrinsics")
    key = f"cameraData[{socket}].extrinsics"
    if not isinstance(extrinsics, dict) or extrinsics.get("toCameraSocket", -1) in (-1, None):
        return
    R = numbers(path, f"{key}.rotationMatrix", extrinsics.get("rotationMatrix"), 9).reshape(3, 3)
    if fault := rotation_fault(R, ROUNDED):
        raise CalibrationError(f"the rotation {fault}", file=path, key=key)
    shift = extrinsics.get("translation")
    values = [shift.get(axis) for axis in "xyz"] if isinstance(shift, dict) else shift
    unit = extrinsics.get("lengthUnit", 1)
    if unit not in range(len(LENGTHS_M)):
        raise CalibrationError(
            f"{unit!r:.20} is no unit that is known here", file=path, key=f"{key}.lengthUnit"
        )
    T = np.eye(4)
    T[:3, :3] = nearest_rotation(R)
    T[:3, 3] = numbers(path, f"{key}.translation", values, 3) * LENGTHS_M[unit]
    yield extrinsics["toCameraSocket"], T


def _camera(path: Path, socket: int, camera: dict[str, Any]) -> CameraModel:
    key = f"cameraData[{socket}]"
    tell_unread(
        path, {name: value for name, value in camera.items() if name not in _CAMERA}, f"{key}: "
    )
    K = numbers(path, f"{key}.intrinsicMatrix", camera.get("intrinsicMatrix"), 9).reshape(3, 3)
    D = numbers(path, f"{key}.distortionCoeff", camera.get("distortionCoeff"))
    kind = camera.get("cameraType", 0)
    if kind not in (0, 1):
        raise CalibrationError(
            f"{kind!r:.20} is neither 0 (perspective) nor 1 (fisheye)",
            file=path,
            key=f"{key}.cameraType",
        )
    if kind == 1 and D[4:].any():
        raise CalibrationError(
            f"a fisheye lens has 4 coefficients, not {len(D)}", file=path, key=key
        )
    lens = tuple(D[:4].tolist()) if kind == 1 else without_tail(D, 5)
    centre = (float(K[0, 2]), float(K[1, 2]))
    return CameraModel(
        (float(K[0, 0]), float(K[1, 1])), centre, lens, "equidistant" if kind == 1 else "pinhole"
    )
