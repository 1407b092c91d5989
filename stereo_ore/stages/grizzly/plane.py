"""Candidate planes by seeded RANSAC, and their refinement on the bars."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereo_ore.config import GrizzlyConfig
from stereo_ore.stages.grizzly.bars import BarFit
from stereo_ore.stages.grizzly.sample import Sample
from stereo_ore.types import F32, Mask, Plane

SCORED = 600
"""Points of the sample that each RANSAC hypothesis is scored on."""
CANDIDATES = 3
MIN_ANGLE_RAD = 0.1
NARROWING = (1.0, 0.7, 0.7)
"""Inlier distances of successive fits, so that a frame a little higher than the bars loses its
pull."""


def candidate_planes(sample: Sample, config: GrizzlyConfig) -> Iterator[tuple[Plane, float]]:
    """The widest planes in turn, each with its area [m²]; the points of one are not offered to the
    next.

    RANSAC: planes through random triples, scored by the area of the points within tolerance times
    the spread of these points, so that a wide sparse screen wins over a compact rock.
    """
    rng = np.random.default_rng(config.seed)
    left = np.ones(len(sample), bool)
    for _ in range(CANDIDATES):
        index = np.flatnonzero(left)
        if len(index) < SCORED // 4:
            return
        chosen = rng.choice(index, min(SCORED, len(index)), replace=False)
        plane = _ransac(sample, chosen, config, rng)
        if plane is None:
            return
        inlier = _inliers(sample, plane) & left
        plane = _least_squares(sample, inlier, plane)
        inlier = _inliers(sample, plane) & left
        yield plane, float(sample.area[inlier].sum())
        left &= ~inlier


def _ransac(
    sample: Sample, chosen: np.ndarray, config: GrizzlyConfig, rng: np.random.Generator
) -> Plane | None:
    xyz, tolerance, area = sample.xyz[chosen], sample.tolerance[chosen], sample.area[chosen]
    a, b, c = xyz[rng.integers(0, len(xyz), (3, config.iterations))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    offsets = np.einsum("ij,ij->i", normals, a[length > 0])
    flip = np.where(offsets > 0, -1.0, 1.0)
    normals, offsets = normals * flip[:, None], offsets * flip
    view = xyz.mean(0) / np.linalg.norm(xyz.mean(0))
    limit = (
        np.cos(config.max_tilt_rad) if config.max_tilt_rad is not None else np.sin(MIN_ANGLE_RAD)
    )
    keep = -(normals @ view) >= limit
    if not keep.any():
        return None
    normals, offsets = normals[keep], offsets[keep]
    points, limit, share = (values.astype(np.float32) for values in (xyz, tolerance, area))
    # In parts: a larger product would wake a pool of threads, which takes longer than the product.
    parts = (np.array_split(values.astype(np.float32), 4) for values in (normals, offsets))
    scores = [
        _scores(normal, offset, points, limit, share) for normal, offset in zip(*parts, strict=True)
    ]
    best = int(np.argmax(np.concatenate(scores)))
    return Plane(normals[best], float(offsets[best]))


def _scores(normals: F32, offsets: F32, xyz: F32, tolerance: F32, area: F32) -> F32:
    """Area of the inliers of each of K hypotheses times the root mean square distance from their
    centre, (K,).
    """
    inlier = (np.abs(normals @ xyz.T - offsets[:, None]) < tolerance).astype(np.float32)
    count = np.maximum(inlier.sum(1), 1)
    centred = xyz - xyz.mean(0)
    mean = inlier @ centred / count[:, None]
    square = inlier @ (centred**2).sum(1) / count
    return np.asarray(
        inlier @ area * np.sqrt(np.maximum(square - (mean**2).sum(1), 0)), dtype=np.float32
    )


def _inliers(sample: Sample, plane: Plane) -> Mask:
    return np.abs(plane.height(sample.xyz)) < sample.tolerance


def _least_squares(sample: Sample, inlier: Mask, fallback: Plane) -> Plane:
    """Total least squares through the inliers, each weighted by area over squared noise."""
    near = np.flatnonzero(inlier)
    if len(near) < 3:
        return fallback
    xyz = sample.xyz[near]
    weight = sample.area[near] / np.maximum(sample.tolerance[near], 1e-6) ** 2
    centre = weight @ xyz / weight.sum()
    scatter = ((xyz - centre) * weight[:, None]).T @ (xyz - centre)
    normal = np.linalg.eigh(scatter)[1][:, 0]
    normal = -normal if normal @ centre > 0 else normal
    return Plane(normal, float(normal @ centre))


def refine_plane(sample: Sample, plane: Plane, fit: BarFit) -> Plane:
    """The plane through the points on the bars alone: not the frame, nor ore that happens to lie at
    their height.
    """
    for narrower in NARROWING:
        near = np.abs(plane.height(sample.xyz)) < narrower * sample.tolerance
        plane = _least_squares(
            sample, near & fit.covers(sample.xyz) if fit.bars is not None else near, plane
        )
    return plane


def residual(sample: Sample, plane: Plane, fit: BarFit) -> tuple[float | None, float]:
    """Root mean square height [m] of the points on the bars, and the share of all points that they
    are.
    """
    on_bars = _on_bars(sample, plane, fit)
    if not on_bars.any():
        return None, 0.0
    height = plane.height(sample.xyz[on_bars])
    return float(np.sqrt(np.mean(height**2))), float(on_bars.mean())


def _on_bars(sample: Sample, plane: Plane, fit: BarFit) -> Mask:
    inlier = _inliers(sample, plane)
    return inlier & fit.covers(sample.xyz) if fit.bars is not None else inlier
