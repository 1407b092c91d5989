"""A grizzly with round lumps, drawn analytically: exact depth, labels and plane in milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F32, F64, I16, Plane, Rig, Surface

RIG = Rig(width=400, height=300, fx=300.0, fy=300.0, cx=199.5, cy=149.5, baseline_m=0.12)
OPENING, WIDTH, DISTANCE = 0.15, 0.05, 1.5
PITCH = OPENING + WIDTH
SIGMA_PX = 0.15


@dataclass(frozen=True)
class Screen:
    """What is drawn: bars in a square hole of a floor or frame, which is cropped beyond `rim`.

    With `cross` bars as wide run across them, so far apart [m]. Lumps are spheres (along the bars,
    across, height of the centre over the bars, radius) [m].
    """

    tilt: float = 0.0
    yaw: float = 0.0
    lumps: tuple[tuple[float, float, float, float], ...] = ()
    half: float = 0.5
    frame_height: float = 0.0
    rim: float = np.inf
    floor: float | None = None
    pit: float = 0.25
    noise_px: float = 0.0
    seed: int = 0
    bars: bool = True
    cross: float | None = None

    @property
    def axes(self) -> F64:
        """Rows: along the bars, across, normal towards the camera."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        flat = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]])
        a, b = np.cos(self.tilt), np.sin(self.tilt)
        return np.asarray(flat @ np.array([[1, 0, 0], [0, a, -b], [0, b, a]]).T)

    @property
    def plane(self) -> Plane:
        normal = self.axes[2]
        return Plane(normal, float(normal @ [0, 0, DISTANCE]))


def draw(screen: Screen) -> tuple[Surface, I16]:
    """The surface and its labels: 0 screen and pit, 1… lumps."""
    v, u = np.mgrid[: RIG.height, : RIG.width]
    ray = np.stack([(u - RIG.cx) / RIG.fx, (v - RIG.cy) / RIG.fy, np.ones(u.shape)], -1)
    depth, shade = _steel(screen, ray)
    labels = np.zeros(u.shape, np.int16)
    for number, (s, c, h, radius) in enumerate(screen.lumps, start=1):
        centre = np.array([0, 0, DISTANCE]) + np.array([s, c, h]) @ screen.axes
        b, a = ray @ centre, (ray**2).sum(-1)
        root = b**2 - a * (centre @ centre - radius**2)
        hit = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        nearer = hit < np.nan_to_num(depth, nan=np.inf)
        nearer &= np.isfinite(hit)
        depth, labels[nearer] = np.where(nearer, hit, depth), number
        shade = np.where(nearer, 90 + 25 * (number % 3), shade)
    return _surface(screen, ray, depth, shade), labels


def _steel(screen: Screen, ray: F64) -> tuple[F64, F64]:
    along, across, normal = screen.axes
    reach = screen.plane.offset / (ray @ normal)
    s, c = (ray @ along) * reach, (ray @ across) * reach
    s, c = s - along[2] * DISTANCE, c - across[2] * DISTANCE
    inside = (np.abs(s) < screen.half) & (np.abs(c) < screen.half)
    bar = inside & (np.abs(c - PITCH * np.round(c / PITCH)) < WIDTH / 2) & screen.bars
    if screen.cross is not None:
        pitch = screen.cross + WIDTH
        bar |= inside & (np.abs(s - pitch * np.round(s / pitch)) < WIDTH / 2)
    solid, pit = ~inside | bar, (screen.plane.offset - screen.pit) / (ray @ normal)
    depth = np.where(solid, reach, pit)
    outside = screen.frame_height if screen.floor is None else -screen.floor
    depth = np.where(~inside, (screen.plane.offset + outside) / (ray @ normal), depth)
    cropped = np.maximum(np.abs(s), np.abs(c)) > screen.half + screen.rim
    return np.where(cropped, np.nan, depth), np.where(solid, 160.0, 40.0)


def _surface(screen: Screen, ray: F64, depth: F64, shade: F64) -> Surface:
    rng = np.random.default_rng(screen.seed)
    disparity = RIG.disparity(depth)
    if screen.noise_px:
        noise = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), 1.0)
        disparity = disparity + screen.noise_px * noise / noise.std()
    depth = RIG.depth(disparity)
    grey = np.clip(shade + rng.normal(0, 5, depth.shape), 0, 255).astype(np.uint8)
    xyz: F32 = (ray * depth[..., None]).astype(np.float32)
    return Surface(
        xyz, np.dstack([grey] * 3), RIG.depth_sigma(depth, SIGMA_PX).astype(np.float32), 0, 0, RIG
    )
