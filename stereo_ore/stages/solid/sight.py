"""What the camera saw of one lump: its surface, its outline, and what lies around the outline."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.planes import PlaneField, crop_rig, fit_planes
from stereo_ore.transforms import frame_from_normal
from stereo_ore.types import F32, F64, I16, Mask, Plane, Rig, Surface

_I64 = npt.NDArray[np.int64]

_MARGIN_PX = 10
"""Pixels around a lump's rectangle that are looked at."""
RING_START_PX, RING_WIDTH = 3.0, 0.1
"""Where the ring around a lump begins, and its width as share of the lump's side."""
SURFACE_PIXELS = 2000
"""Larger lumps are looked at with a stride, for time."""
SURFACE_SAMPLES = 450
"""Surface points used; more do not change the body."""
THINNEST = 0.06
"""Radius of the disc that fits everywhere into a silhouette, as share of its side: bars beside a
lump are thinner."""
MIXED_RMS = 0.1
"""A fitted plane whose residual exceeds this share of the lump's size mixes it with what lies
behind."""
STEP = 0.06
"""Depth difference across the outline, as share of the lump's size, that tells contact from a
gap."""
SLOPE_SIGMA = 0.05
"""Error [rad] wanted of a smoothed surface's slope."""
_LARGEST_WINDOW = 0.2
"""Largest side of the smoothing window as share of the lump's."""
EDGE_PX = 4.0
"""Width of the band along the outline in which depth is trusted less [px]."""
MIN_OUTLINE = 8
"""Fewer outline pixels tell nothing."""
NEAR = 0.6
"""Reach around the outline, as share of the lump's size, within which a surface may carry the
lump."""


@dataclass(frozen=True)
class Ring:
    """What lies just outside a lump's outline, by pixel (R,), beside the outline pixel nearest to
    it.

    Heights [m] over the screen `outside` and `inside`; `step` [m] is how much deeper than the
    outline the outside is, `gap` [m] the distance between the two, `other` whether another lump
    lies there. `count` is the number of pixels, with or without depth.
    """

    outside: F64
    inside: F64
    step: F64
    gap: F64
    other: Mask
    count: int


@dataclass(frozen=True)
class Sight:
    """A lump in its own frame: x away from the camera along the screen, z along the screen's
    normal, origin on it.

    Lengths in metres. `axes` (3, 3) are the frame's axes as rows and `origin` (3,) its origin,
    camera frame. `size` is the square root of the silhouette's area, `sigma_z` the depth noise of a
    pixel, `view` (3,) the viewing direction. `points` (N, 3) and `normals` (N, 3) sample the
    smoothed surface, `outline` (K, 3) is its own outline where nothing hides it, `silhouette` (3,)
    the centroid of the filled silhouette at the outline's mean depth, `solidity` its share of its
    convex hull's area.
    """

    axes: F64
    origin: F64
    size: float
    sigma_z: float
    view: F64
    points: F64
    normals: F64
    outline: F64
    silhouette: F64
    solidity: float
    ring: Ring

    @property
    def tilt(self) -> float:
        """Sine of the angle between the viewing direction and the screen's normal."""
        return float(np.hypot(self.view[0], self.view[1]))

    def to_camera(self, xyz: F64) -> F64:
        """Points (..., 3) of the lump's frame in the camera frame."""
        return xyz @ self.axes + self.origin


@dataclass(frozen=True)
class _Crop:
    """A lump's rectangle: labels, lump and measured pixels (h, w), points and planes fitted to
    them, geometry.
    """

    lump: Mask
    other: Mask
    seen: Mask
    known: Mask
    xyz: F32
    planes: PlaneField
    size: float
    sigma_z: float
    rig: Rig

    def points(self, at: _I64) -> F64:
        """Points (N, 3) at flat indices, those of the lump's own surface smoothed."""
        xyz = self.xyz.reshape(-1, 3)[at].astype(np.float64)
        smooth = 1.0 / (self.planes.inverse.ravel()[at] * xyz[:, 2])
        return xyz * np.where(self.seen.ravel()[at], smooth, 1.0)[:, None]


def look_at_lumps(
    surface: Surface,
    labels: I16,
    box: tuple[slice, ...],
    number: int,
    plane: Plane,
    min_points: int,
) -> Sight | None:
    """Gather the sight of lump `number`, whose pixels in the crop's `labels` (h, w) lie in `box`;
    None if too few.
    """
    crop = _crop(surface, labels, box, number, min_points)
    if crop is None:
        return None
    rim = _edge(crop.lump)
    edge = rim & crop.seen
    if crop.seen.sum() < min_points or edge.sum() < MIN_OUTLINE:
        return None
    sample = _thinned(crop.seen)
    points = crop.points(np.flatnonzero(sample))
    view = points.mean(0)
    axes, origin = _lump_frame(view, plane)
    ring, hidden = _ring(crop, edge, axes, origin)
    own = np.flatnonzero(edge.ravel() & ~hidden)
    own = own if len(own) >= MIN_OUTLINE else np.flatnonzero(edge)
    outline = crop.points(own)
    v, u = np.nonzero(crop.lump)
    middle = crop.rig.back_project(u.mean(), v.mean(), outline[:, 2].mean())
    return Sight(
        axes=axes,
        origin=origin,
        size=crop.size,
        sigma_z=crop.sigma_z,
        view=axes @ (view / np.linalg.norm(view)),
        points=(points - origin) @ axes.T,
        normals=crop.planes.normal(sample) @ axes.T,
        outline=(outline - origin) @ axes.T,
        silhouette=(middle - origin) @ axes.T,
        solidity=_solidity(crop.lump, rim),
        ring=ring,
    )


def _crop(
    surface: Surface, labels: I16, box: tuple[slice, ...], number: int, min_points: int
) -> _Crop | None:
    """Cut a lump out, with a margin and perhaps a stride, and smooth its surface by planes."""
    stride = max(1, round(float(np.sqrt((labels[box] == number).sum() / SURFACE_PIXELS))))
    rows, columns = (
        slice(max(s.start - _MARGIN_PX * stride, 0), s.stop + _MARGIN_PX * stride, stride)
        for s in box
    )
    labels, xyz = labels[rows, columns], np.ascontiguousarray(surface.xyz[rows, columns])
    rig = crop_rig(surface.rig, surface.x0 + columns.start, surface.y0 + rows.start, stride)
    depth = np.ascontiguousarray(xyz[..., 2])
    lump, known = _without_spurs(labels == number), np.isfinite(depth)
    seen = lump & known
    count = int(seen.sum())
    if count < min_points:
        return None
    pixels = float(lump.sum())
    size = float(np.sqrt(pixels / (rig.fx * rig.fy)) * np.median(depth[seen]))
    sigma_z = float(np.median(surface.sigma_z[rows, columns][seen]))
    planes = fit_planes(
        depth, _trust(lump) * seen, _window(size / np.sqrt(pixels), sigma_z, count), rig
    )
    seen &= planes.rms < MIXED_RMS * size
    if not seen.any():
        return None
    return _Crop(
        lump, (labels > 0) & (labels != number), seen, known, xyz, planes, size, sigma_z, rig
    )


def _without_spurs(lump: Mask) -> Mask:
    """The largest part of a silhouette that is nowhere thinner than `THINNEST` allows; all of it if
    there is none.
    """
    radius = max(1, round(THINNEST * float(np.sqrt(lump.sum()))))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(lump.astype(np.uint8), cv2.MORPH_OPEN, disc)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    return np.asarray(parts == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else lump


def _solidity(lump: Mask, rim: Mask) -> float:
    """Share of its convex hull's area that a silhouette fills; the hull goes through the centres of
    pixels.
    """
    hull = cv2.convexHull(cv2.findNonZero(rim.astype(np.uint8)))
    return float(lump.sum() / (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1.0))


def _window(pixel_m: float, sigma_z: float, count: int) -> int:
    """Odd side [px] of the smoothing window: as large as steady slopes need, as small as the lump's
    shape asks.

    A slope fitted to n × n points of spacing p and noise σ has the standard deviation √12·σ/(n²·p).
    """
    steady = np.sqrt(np.sqrt(12.0) * sigma_z / (SLOPE_SIGMA * pixel_m))
    return 2 * int(0.5 * min(max(steady, 5.0), max(_LARGEST_WINDOW * np.sqrt(count), 5.0))) + 1


def _trust(lump: Mask) -> F32:
    """Weight of a pixel's depth: matchers err beside the outline, where the window sees two
    surfaces.
    """
    inside = cv2.distanceTransform(lump.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.clip((inside / np.float32(EDGE_PX)) ** 2, 0.02, 1.0), np.float32)


def _ring(crop: _Crop, edge: Mask, axes: F64, origin: F64) -> tuple[Ring, Mask]:
    """The ring around a lump, and which pixels (h·w,) of its edge something nearer hides."""
    at_outside, at_inside, count = _across(crop.lump, edge, crop.known)
    outside, inside = crop.points(at_outside), crop.points(at_inside)
    step = outside[:, 2] - inside[:, 2]
    hidden = np.zeros(crop.lump.size, bool)
    hidden[at_inside[step < -STEP * crop.size]] = True
    gap = np.sqrt(((outside - inside) ** 2).sum(1))
    other = crop.other.ravel()[at_outside]
    return Ring(
        (outside - origin) @ axes[2], (inside - origin) @ axes[2], step, gap, other, count
    ), hidden


def _thinned(seen: Mask) -> Mask:
    """At most about `SURFACE_SAMPLES` of the pixels, on a regular grid."""
    skip = max(1, round(float(np.sqrt(seen.sum() / SURFACE_SAMPLES))))
    sample = np.zeros_like(seen)
    sample[::skip, ::skip] = seen[::skip, ::skip]
    return sample


def _lump_frame(middle: F64, plane: Plane) -> tuple[F64, F64]:
    """Axes as rows and origin: the middle (3,) of the points brought down to the plane."""
    origin = middle - plane.height(middle) * plane.normal
    ray = middle / np.linalg.norm(middle)
    steep = 1.0 - (ray @ plane.normal) ** 2 < 1e-6
    return frame_from_normal(plane.normal, np.array([0.0, -1.0, 0.0]) if steep else ray), origin


def _edge(lump: Mask) -> Mask:
    """Outermost pixels of the lump; the border of the crop is no edge."""
    kernel = np.ones((3, 3), np.uint8)
    inner = cv2.erode(lump.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(lump & (inner == 0))


def _across(lump: Mask, edge: Mask, known: Mask) -> tuple[_I64, _I64, int]:
    """Flat indices of the ring's measured pixels and of the edge pixel nearest to each; how many
    pixels the ring has.

    Pixels nearer to the lump than `RING_START_PX` are passed over: matchers give them the lump's
    own depth.
    """
    distance, nearest = cv2.distanceTransformWithLabels(
        (~edge).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    width = max(3.0, RING_WIDTH * float(np.sqrt(lump.sum())))
    ring = ~lump & (distance > RING_START_PX) & (distance <= RING_START_PX + width)
    pixels = np.nonzero(edge.ravel())[0]
    table = np.zeros(int(nearest.max()) + 1, np.int64)
    table[nearest.ravel()[pixels]] = pixels
    outside = np.nonzero((ring & known).ravel())[0]
    return outside, table[nearest.ravel()[outside]], int(ring.sum())
