"""A scene as a folder: images, truth, and calibration and site in the native formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.errors import OutputError
from stereo_ore.io.calibration import save
from stereo_ore.io.site import save_site
from stereo_ore.lab.synth.scene import Scene
from stereo_ore.lab.synth.truth import LumpTruth
from stereo_ore.types import F64, CameraModel


def write(scene: Scene, folder: Path) -> Path:
    """Write left.png, right.png, calib.json, gt.npz and gt.json (mm), calibration.yaml and
    site.yaml (m).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for side in ("left", "right"):
            encoded = cv2.imencode(".png", getattr(scene.pair, side))[1]
            (folder / f"{side}.png").write_bytes(encoded.tobytes())
        _write_json(folder / "calib.json", _calib(scene))
        _write_json(folder / "gt.json", _truth(scene))
        np.savez_compressed(folder / "gt.npz", **_arrays(scene))
        save(scene.calibration, folder / "calibration.yaml")
        save_site(scene.site, folder / "site.yaml")
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror}", file=folder) from None
    return folder


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n")


def _arrays(scene: Scene) -> dict[str, Any]:
    def depth_mm(depth: Any) -> Any:
        return np.nan_to_num(depth * 1000, nan=0.0).round(2).astype(np.float32)

    arrays = {
        "depth_left_mm": depth_mm(scene.raw_depth_m),
        "instance_left": scene.raw_instance.astype(np.uint8),
    }
    if scene.spec.raw:
        arrays["depth_left_rect_mm"] = depth_mm(scene.depth_m)
        arrays["instance_left_rect"] = scene.instance.astype(np.uint8)
    return arrays


def _calib(scene: Scene) -> dict[str, Any]:
    c, (width, height) = scene.calibration, scene.calibration.image_size
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = c.R_right_left, c.t_right_left
    document: dict[str, Any] = {
        "rectified": c.images == "rectified",
        "width": width,
        "height": height,
    }
    if scene.spec.raw:
        document |= {
            "model": "OpenCV pinhole, k1 k2 p1 p2 k3",
            "left": _lens(c.left),
            "right": _lens(c.right),
        }
        document |= {
            "R_right_left": c.R_right_left.tolist(),
            "t_right_left_mm": (c.t_right_left * 1000).tolist(),
        }
        document["reference_rectification"] = _reference(scene)
    else:
        document |= {"K": c.left.K.tolist(), "dist": [0.0] * 5}
    document["baseline_mm"] = float(np.linalg.norm(c.t_right_left)) * 1000
    document["T_world_left"] = _millimetres(scene.spec.camera.T_world_left)
    document["T_world_right"] = _millimetres(
        scene.spec.camera.T_world_left @ np.linalg.inv(T_right_left)
    )
    return document


def _lens(camera: CameraModel) -> dict[str, Any]:
    return {"K": camera.K.tolist(), "dist": list(camera.distortion)}


def _reference(scene: Scene) -> dict[str, Any]:
    r = scene.rectified
    P2 = r.P2.copy()
    P2[:, 3] *= 1000
    call = "cv2.stereoRectify(K_l, d_l, K_r, d_r, size, R, T, flags=CALIB_ZERO_DISPARITY, alpha=0)"
    return {
        "call": call,
        "R1": r.R1.tolist(),
        "R2": r.R2.tolist(),
        "P1": r.P1.tolist(),
        "P2": P2.tolist(),
    }


def _millimetres(T: F64) -> list[list[float]]:
    scaled = T.copy()
    scaled[:3, 3] *= 1000
    return [[round(float(value), 9) for value in row] for row in scaled]


def _truth(scene: Scene) -> dict[str, Any]:
    spec, screen = scene.spec, scene.spec.screen
    T_left_screen = np.linalg.inv(spec.camera.T_world_left) @ spec.T_world_screen
    normal, origin = T_left_screen[:3, 2], T_left_screen[:3, 3]
    return {
        "name": spec.name, "family": spec.family, "units": "mm, pixels, degrees", "seed": spec.seed,
        "instance_ids": "0 background and pit, 1 grizzly, 2.. lumps", "n_lumps": len(scene.lumps),
        "clear_opening_mm": screen.opening * 1000, "bar_width_mm": screen.bar_width * 1000,
        "bar_depth_mm": screen.bar_depth * 1000, "n_bars": len(screen.bar_centres),
        "screen_size_mm": [s * 1000 for s in screen.size],
        "bar_centres_x_mm": (screen.bar_centres * 1000).tolist(),
        "tilt_deg": np.degrees(spec.tilt).tolist(),
        "T_world_screen": _millimetres(spec.T_world_screen),
        "T_left_screen": _millimetres(T_left_screen),
        "screen_plane_left": {"normal": normal.tolist(),
            "offset_mm": float(normal @ origin) * 1000},
        "camera": {"height_m": spec.camera.height,
            "pitch_deg": float(np.degrees(spec.camera.pitch))},
        "full_well_e": spec.sensor.full_well, "read_noise_e": spec.sensor.read_noise,
        "gain": list(spec.sensor.gain), "contrast": spec.sensor.contrast,
        "wet": spec.wet, "haze_per_m": spec.haze_per_m,
        "lumps": [_lump(lump, raw=spec.raw) for lump in scene.lumps],
    }  # fmt: skip


def _lump(lump: LumpTruth, raw: bool) -> dict[str, Any]:
    depth = lump.depth_range or (None, None)
    document = {
        "id": lump.id, "volume_mm3": lump.volume_m3 * 1e9,
        "com_left_mm": (lump.com_left * 1000).round(4).tolist(),
        "com_world_mm": (lump.com_world * 1000).round(4).tolist(),
        "visible_pixels": lump.visible_pixels,
        "unoccluded_pixels": lump.unoccluded_pixels,
        "visible_fraction": round(lump.visible_fraction, 4),
        "cut_by_image_border": lump.cut, "bbox_xyxy": lump.bbox_xyxy,
        "depth_mm_min": None if depth[0] is None else depth[0] * 1000,
        "depth_mm_max": None if depth[1] is None else depth[1] * 1000,
        "obb_dims_mm": (lump.box_dims * 1000).round(4).tolist(),
        "max_caliper_mm": lump.max_calliper * 1000,
        "min_caliper_mm": lump.min_calliper * 1000, "oversize": lump.oversize, "ore": lump.ore,
        "shape": lump.shape,
        "touches": list(lump.touches),
    }  # fmt: skip
    if raw:
        rect = (lump.com_rectified * 1000).round(4).tolist()
        document |= {"com_left_rect_mm": rect, "visible_pixels_rect": lump.visible_pixels_rectified}
    return document
