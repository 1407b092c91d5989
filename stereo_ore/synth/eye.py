"""A camera in the scene: its rays, and what lies on them exactly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.synth.mesh import cast
from stereo_ore.synth.model import Model
from stereo_ore.types import F32, F64, I32, CameraModel


@dataclass(frozen=True)
class Eye:
    """A camera of (W, H) pixels with its pose in the screen frame; distortion is that of `camera`."""

    camera: CameraModel
    size: tuple[int, int]
    T_screen_eye: F64

    def rays(self, rows: range, columns: range | None = None, offset: tuple[float, float] = (0.0, 0.0)) -> F32:
        """Rays (rows, columns, 6) in the screen frame through pixel centres moved by `offset`.

        Directions have z_eye = 1, so that the distance along a ray is depth. All columns are taken by default.
        """
        u = np.array(range(self.size[0]) if columns is None else columns, np.float64) + offset[0]
        v = np.array(rows, np.float64) + offset[1]
        R, t = self.T_screen_eye[:3, :3], self.T_screen_eye[:3, 3].astype(np.float32)
        rays = np.empty((len(v), len(u), 6), np.float32)
        rays[..., :3] = t
        if self.camera.distortion:
            pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 1, 2)
            xy = cv2.undistortPoints(pixels, self.camera.K, np.array(self.camera.distortion))
            rays[..., 3:] = (xy.reshape(len(v), len(u), 2) @ R[:, :2].T + R[:, 2]).astype(np.float32)
        else:
            (fx, fy), (cx, cy) = self.camera.focal_px, self.camera.principal_point_px
            across, down = (u - cx)[:, None] / fx * R[:, 0], (v - cy)[:, None] / fy * R[:, 1] + R[:, 2]
            np.add(across.astype(np.float32), down.astype(np.float32)[:, None], out=rays[..., 3:])
        return rays


def depth_and_instance(model: Model, eye: Eye) -> tuple[F32, I32]:
    """Exact z [m] (H, W), NaN where nothing is hit, and instance ids (H, W) at pixel centres."""
    hit = cast(model.caster, eye.rays(range(eye.size[1])))
    seen = np.isfinite(hit["t_hit"])
    instance_of = np.array([p.instance for p in model.parts], np.int32)[model.part_of]
    triangle = np.where(seen, hit["primitive_ids"], 0).astype(np.int64)
    depth = np.where(seen, hit["t_hit"], np.nan).astype(np.float32)
    return depth, np.where(seen, instance_of[triangle], 0).astype(np.int32)
