"""A camera in the scene: its rays, and what lies on them exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np

from stereo_ore.lab.synth.mesh import cast
from stereo_ore.lab.synth.model import Model
from stereo_ore.types import F32, F64, I32, CameraModel

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline


@dataclass(frozen=True)
class Eye:
    """A camera of (W, H) pixels with its pose in the screen frame; distortion is that of
    `camera`.
    """

    camera: CameraModel
    size: tuple[int, int]
    T_screen_eye: F64

    def rays(
        self, rows: range, columns: range | None = None, offset: tuple[float, float] = (0.0, 0.0)
    ) -> F32:
        """Rays (rows, columns, 6) in the screen frame through pixel centres moved by `offset`.

        Directions have z_eye = 1, so that the distance along a ray is depth. All columns are taken
        by default.
        """
        u = np.array(range(self.size[0]) if columns is None else columns, np.float64) + offset[0]
        v = np.array(rows, np.float64) + offset[1]
        R, t = self.T_screen_eye[:3, :3], self.T_screen_eye[:3, 3].astype(np.float32)
        rays = np.empty((len(v), len(u), 6), np.float32)
        rays[..., :3] = t
        if self.camera.distortion:
            xy = np.stack([spline(v, u) for spline in self._lens], -1)
            rays[..., 3:] = (xy @ R[:, :2].T + R[:, 2]).astype(np.float32)
        else:
            (fx, fy), (cx, cy) = self.camera.focal_px, self.camera.principal_point_px
            across, down = (
                (u - cx)[:, None] / fx * R[:, 0],
                (v - cy)[:, None] / fy * R[:, 1] + R[:, 2],
            )
            np.add(across.astype(np.float32), down.astype(np.float32)[:, None], out=rays[..., 3:])
        return rays

    @cached_property
    def _lens(self) -> tuple[RectBivariateSpline, ...]:
        """Splines of the normalised coordinates x and y over (row, column), fitted every 8 px."""
        from scipy.interpolate import RectBivariateSpline

        u, v = (np.arange(-8.0, side + 16, 8) for side in self.size)
        xy = undistorted(self.camera, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)).reshape(
            len(v), len(u), 2
        )
        return tuple(RectBivariateSpline(v, u, xy[..., k]) for k in (0, 1))


def undistorted(camera: CameraModel, pixels: F64) -> F64:
    """Normalised coordinates (N, 2) that the lens model projects to pixels (N, 2), to about 1e-4
    px.

    `cv2.undistortPoints` stops after five steps, up to half a pixel off in the corners; thirty more
    are made here.
    """
    distortion, focal = np.array(camera.distortion), np.array(camera.focal_px)
    xy = np.asarray(
        cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K, distortion), np.float64
    ).reshape(-1, 2)
    for _ in range(30):
        rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
        projected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, distortion)[
            0
        ].reshape(-1, 2)
        xy = xy + (pixels - projected) / focal
    return xy


def depth_and_instance(model: Model, eye: Eye) -> tuple[F32, I32]:
    """Exact z [m] (H, W), NaN where nothing is hit, and instance ids (H, W) at pixel centres."""
    hit = cast(model.caster, eye.rays(range(eye.size[1])))
    seen = np.isfinite(hit["t_hit"])
    instance_of = np.array([p.instance for p in model.parts], np.int32)[model.part_of]
    triangle = np.where(seen, hit["primitive_ids"], 0).astype(np.int64)
    depth = np.where(seen, hit["t_hit"], np.nan).astype(np.float32)
    return depth, np.where(seen, instance_of[triangle], 0).astype(np.int32)
