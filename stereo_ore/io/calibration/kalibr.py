"""Kalibr camera chains: cam0, cam1, … with ``T_cn_cnm1``, the transform from the camera before
[m].
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.config.validation import nearest_word
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.file_storage import plain_yaml
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    rigid_transform,
    size_of,
    tell_unread,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.transforms import inverse
from stereo_ore.types import F64, CameraModel, StereoCalibration

AGREE = 1e-3
"""Difference of rotation entries and metres between two ways from one camera to the other."""

_CHAIN = re.compile(r"^cam\d+:", re.MULTILINE)
_KNOWN = (
    "camera_model",
    "intrinsics",
    "distortion_model",
    "distortion_coeffs",
    "resolution",
    "T_cn_cnm1",
    "T_cam_imu",
    "T_imu_cam",
    "rostopic",
    "cam_overlaps",
    "timeshift_cam_imu",
)


def recognises(text: str) -> bool:
    """Whether the text is a camera chain."""
    return bool(_CHAIN.search(text)) and "distortion_model" in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """Two cameras of a chain; `hints.eyes` says which when there are more.

    Raises
    ------
    CalibrationError
        When a key is missing, a model is not radtan or equidistant, or the two cameras are not
        said.
    """
    chain = _cameras(path, parse_yaml(plain_yaml(text), path, CalibrationError, aliases=True))
    if hints.eyes is None and len(chain) != 2:
        remedy = "Say which are left and right with --eyes L,R"
        raise CalibrationError(
            f"holds {len(chain)} cameras: {', '.join(map(str, chain))}", file=path, remedy=remedy
        )
    left, right = hints.eyes or tuple(chain)
    for index in (left, right):
        if index not in chain:
            raise CalibrationError(
                f"has no cam{index}{nearest_word(f'cam{index}', (f'cam{i}' for i in chain))}",
                file=path,
            )
    if hints.images == "rectified":
        raise CalibrationError("Kalibr describes raw images, not rectified ones", file=path)
    T_right_left = _between(path, chain, left, right)
    sizes = [size_of(path, chain[index].get("resolution"), hints) for index in (left, right)]
    if sizes[0] != sizes[1]:
        raise CalibrationError(
            f"cam{left} has images of {sizes[0]} px, cam{right} of {sizes[1]}", file=path
        )
    return make_calibration(
        path,
        image_size=sizes[0],
        left=_camera(path, f"cam{left}", chain[left]),
        right=_camera(path, f"cam{right}", chain[right]),
        rotation=T_right_left[:3, :3],
        translation_m=T_right_left[:3, 3],
        images="raw",
        camera=f"{path.stem} cam{left} cam{right}",
    )


def _cameras(path: Path, data: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """The cameras by number."""
    chain = {
        int(key[3:]): value for key, value in data.items() if re.fullmatch(r"cam\d{1,6}", str(key))
    }
    for index, camera in chain.items():
        if not isinstance(camera, dict):
            raise CalibrationError("must be a mapping", file=path, key=f"cam{index}")
    tell_unread(
        path,
        {key: value for key, value in data.items() if not re.fullmatch(r"cam\d{1,6}", str(key))},
    )
    return dict(sorted(chain.items()))


def _get(path: Path, name: str, camera: dict[str, Any], key: str) -> Any:
    if key not in camera:
        raise CalibrationError(
            f"key is missing{nearest_word(key, map(str, camera))}", file=path, key=f"{name}.{key}"
        )
    return camera[key]


def _between(path: Path, chain: dict[int, dict[str, Any]], left: int, right: int) -> F64:
    """``T_right_left``, by the links of the chain or by what both cameras know of the IMU; both
    must agree.
    """
    ways = []
    if all("T_cn_cnm1" in chain.get(link, {}) for link in range(1, max(left, right) + 1)):
        ways.append(_to_first(path, chain, right) @ inverse(_to_first(path, chain, left)))
    imu = [_from_imu(path, f"cam{index}", chain[index]) for index in (left, right)]
    if imu[0] is not None and imu[1] is not None:
        ways.append(imu[1] @ inverse(imu[0]))
    if not ways:
        missing = next(
            i for i in range(1, max(left, right) + 1) if "T_cn_cnm1" not in chain.get(i, {})
        )
        _get(path, f"cam{missing}", chain.get(missing, {}), "T_cn_cnm1")
    if len(ways) == 2 and np.abs(ways[0] - ways[1]).max() > AGREE:
        problem = f"T_cn_cnm1 and T_cam_imu differ by up to {np.abs(ways[0] - ways[1]).max():.2g}"
        raise CalibrationError(
            problem, file=path, key=f"cam{right}", remedy="Leave the older of them out"
        )
    return ways[0]


def _from_imu(path: Path, name: str, camera: dict[str, Any]) -> F64 | None:
    """``T_camera_imu`` from T_cam_imu or, as OpenVINS writes it, its inverse T_imu_cam."""
    for key in ("T_cam_imu", "T_imu_cam"):
        if key in camera:
            T = rigid_transform(path, f"{name}.{key}", camera[key])
            return T if key == "T_cam_imu" else inverse(T)
    return None


def _to_first(path: Path, chain: dict[int, dict[str, Any]], index: int) -> F64:
    """``T_camera_cam0``, the product of the links."""
    T = np.eye(4)
    for link in range(1, index + 1):
        T = rigid_transform(path, f"cam{link}.T_cn_cnm1", chain[link]["T_cn_cnm1"]) @ T
    return T


def _camera(path: Path, name: str, camera: dict[str, Any]) -> CameraModel:
    tell_unread(
        path, {key: value for key, value in camera.items() if key not in _KNOWN}, f"{name}: "
    )
    kind, model = (_get(path, name, camera, key) for key in ("camera_model", "distortion_model"))
    if kind != "pinhole":
        raise CalibrationError(
            f"{kind!r} is not supported, only pinhole", file=path, key=f"{name}.camera_model"
        )
    if model not in ("radtan", "equidistant", "none"):
        problem = f"{model!r} is not one of radtan, equidistant, none"
        raise CalibrationError(problem, file=path, key=f"{name}.distortion_model")
    fx, fy, cx, cy = numbers(
        path, f"{name}.intrinsics", _get(path, name, camera, "intrinsics"), 4
    ).tolist()
    D = () if model == "none" else _get(path, name, camera, "distortion_coeffs")
    distortion = tuple(
        numbers(path, f"{name}.distortion_coeffs", D, None if model == "none" else 4).tolist()
    )
    return CameraModel(
        (fx, fy), (cx, cy), distortion, "equidistant" if model == "equidistant" else "pinhole"
    )
