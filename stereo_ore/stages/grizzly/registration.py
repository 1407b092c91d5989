"""Where the bars are measured against where they are known to be, and the disparity with that
difference taken off.

The disparity of a plane is linear in the pixel, and so is what a wrong baseline, principal column
or offset adds to it, or a camera that was nudged. Bars make up thousands of pixels, so this field
is measured to hundredths of a pixel, where a single depth is off by several of its standard
deviations before a check of the screen dares to speak.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_ore.config import GrizzlyConfig
from stereo_ore.stages.grizzly.bars import BarFit, fit_bars
from stereo_ore.stages.grizzly.sample import Sample, tolerances
from stereo_ore.types import F32, F64, BarLine, Disparity, Mask, Plane, Registration, Rig, Site

_SAMPLE = 10_000
"""Pixels looked at."""
WINDOWS = (0.5, 1.5)
"""Bars are looked for this far above and below their place [openings]; those that only the wider
search finds are too far off to be put right, which is for the checks to say."""
_BIN_PX, SMOOTH_BINS = 0.1, 7
TUKEY_PX = (1.5, 1.0, 0.7, 0.5, 0.5)
"""Residuals [px] beyond which a pixel has no weight, of successive fits (Beaton & Tukey 1974)."""
_INNER = 0.7
"""Share of a bar's width that is looked at: its edges are smeared."""
_RIDGE = 0.35
"""And of a round one's: beside its ridge it falls off by a thirtieth of its width at most."""
_ROUNDS = 2
"""Times the plane is fitted to the bars: those found in a plane of what is near, ore and floor and
all, then those found in that of the bars."""
_CLEAR = 0.3
"""Contrast of bars in the known plane, moved as most of what is near is, with which they are found
in no other."""
_FEWEST, LEAST_WEIGHT = 100, 0.2
"""Pixels on bars, with at least this weight in the last fit, that are needed."""
_TILE_RAD, _FEWEST_TILES = 0.15, 6
"""Side of the tiles within which the matcher's errors are common (40 px of a VGA eye), and how many
tell of their size."""
LEAST_CONTRAST = 0.15
"""Contrast of the bars in what is solid and open, below which it is not bars that were measured."""


def register(
    disparity: Disparity, rig: Rig, plane: Plane, site: Site, config: GrizzlyConfig
) -> Registration | None:
    """How the bars' disparity differs from that of the plane where they are known to be.

    Parameters
    ----------
    disparity : Disparity
        As matched.
    rig : Rig
        Geometry of the rectified pair.
    plane : Plane
        Plane of the bar tops.
    site : Site
        Opening and width of the bars, as far as they are known, and the working volume.
    config : GrizzlyConfig
        Tolerances.

    Returns
    -------
    Registration or None
        None where too little of the bars is seen, or nothing near their place.
    """
    pixels = _draw(disparity, rig, plane, site)
    searched = (_within(w * _opening(site), pixels, rig, plane, site, config) for w in WINDOWS)
    return next((found for found in searched if found is not None), None)


def _within(
    window_m: float, pixels: _Pixels, rig: Rig, plane: Plane, site: Site, config: GrizzlyConfig
) -> Registration | None:
    """The registration from pixels that are so near to the plane."""
    near = pixels.where(np.abs(plane.height(pixels.xyz)) < window_m)
    if len(near.excess) < _FEWEST:
        return None

    def bars(field: F64) -> BarFit:
        return _bars(pixels, rig, plane_of(rig, plane, field), site, config)

    field = np.array([_mode(near.excess), 0.0, 0.0])
    fit = bars(field)
    if fit.contrast < _CLEAR:
        # Turned, perhaps; or what is smeared between the bars turns the plane of all that is near.
        tilted = _tukey(near, field)[0]
        field, fit = max((field, fit), (tilted, bars(tilted)), key=lambda start: start[1].contrast)
    for again in range(_ROUNDS):
        fit = bars(field) if again else fit
        if fit.bars is None:
            return None
        inner = fit.narrowed(_INNER if site.bar_profile == "flat" else _RIDGE)
        on_bars = pixels.where(inner.covers(pixels.on(plane_of(rig, plane, field))))
        if len(on_bars.excess) < _FEWEST:
            return None
        field, weight = _tukey(on_bars, field)
    if fit.contrast < LEAST_CONTRAST:
        return None
    seen = weight > LEAST_WEIGHT
    if seen.sum() < _FEWEST or (covariance := _covariance(on_bars, field, weight)) is None:
        return None
    moved = _described(on_bars.where(seen), pixels, rig, plane, field, covariance)
    return moved if site.bar is None else _beside(moved, fit, plane_of(rig, plane, field), site.bar)


def corrected(disparity: Disparity, registration: Registration | None, rig: Rig) -> Disparity:
    """The disparity with the bars where they are known to be: all points move along their rays."""
    if registration is None:
        return disparity
    region = disparity.region
    x = (np.arange(region.x0, region.x1) - rig.cx) / rig.fx
    y = (np.arange(region.y0, region.y1) - rig.cy) / rig.fy
    constant, along_x, along_y = registration.field_px
    across, down = (constant + along_x * x).astype(np.float32), (along_y * y).astype(np.float32)

    def moved(values: F32) -> F32:
        values = values.copy()
        values[region.slices] -= across[None, :]
        values[region.slices] -= down[:, None]
        return values

    measured = None if disparity.measured is None else moved(disparity.measured)
    return replace(disparity, values=moved(disparity.values), measured=measured)


@dataclass(frozen=True)
class _Pixels:
    """Rays (N, 3) of pixels, z = 1; depth (N,) [m]; disparity over the plane's (N,) [px]; area of a
    pixel over z².
    """

    rays: F64
    depth: F64
    excess: F64
    area: float

    def where(self, mask: Mask) -> _Pixels:
        return _Pixels(self.rays[mask], self.depth[mask], self.excess[mask], self.area)

    @property
    def xyz(self) -> F64:
        """Where the points are, (N, 3) [m]."""
        return np.asarray(self.rays * self.depth[:, None])

    def on(self, plane: Plane) -> F64:
        """Where the rays meet a plane, (N, 3) [m]."""
        return np.asarray(self.rays * (plane.offset / (self.rays @ plane.normal))[:, None])


def _draw(disparity: Disparity, rig: Rig, plane: Plane, site: Site) -> _Pixels:
    """Pixels of a regular grid whose rays meet the plane in the working volume."""
    region = disparity.region
    step = max(1, int(np.sqrt((region.x1 - region.x0) * (region.y1 - region.y0) / _SAMPLE)))
    values: F32 = disparity.values[region.slices][::step, ::step]
    v, u = np.nonzero(values + np.float32(rig.doffs_px) > 0)
    total = values[v, u].astype(np.float64) + rig.doffs_px
    rays = rig.back_project(u * step + region.x0, v * step + region.y0, np.ones(len(u)))
    focal_baseline = rig.fx * rig.baseline_m
    excess = np.asarray(total - focal_baseline * (rays @ plane.normal) / plane.offset)
    pixels = _Pixels(rays, focal_baseline / total, excess, (step / rig.fx) ** 2)
    return pixels if site.volume is None else pixels.where(site.volume.contains(pixels.on(plane)))


def _opening(site: Site) -> float:
    return site.opening_m if site.opening_m is not None else 0.3


def _mode(excess: F64) -> float:
    counts, edges = np.histogram(
        excess, np.arange(excess.min(), excess.max() + 2 * _BIN_PX, _BIN_PX)
    )
    smooth = np.convolve(counts, np.ones(SMOOTH_BINS), "same")
    return float(edges[int(smooth.argmax())] + _BIN_PX / 2)


def _tukey(pixels: _Pixels, field: F64) -> tuple[F64, F64]:
    """The field c·(x, y, 1) with Tukey's weights, and these (N,); `field` is ordered (constant, x,
    y).
    """
    basis = pixels.rays[:, [2, 0, 1]]
    weight = np.ones(len(basis))
    for width in TUKEY_PX:
        residual = pixels.excess - basis @ field
        weight = np.where(np.abs(residual) < width, (1 - (residual / width) ** 2) ** 2, 0.0)
        # Sums without BLAS, whose order depends on the number of threads.
        normal = np.einsum("ni,nj->ij", basis * weight[:, None], basis)
        field = np.linalg.lstsq(
            normal, np.einsum("ni,n->i", basis, weight * pixels.excess), rcond=None
        )[0]
    return field, weight


def plane_of(rig: Rig, plane: Plane, field: F64) -> Plane:
    """The plane whose disparity is that of `plane` and the field."""
    scaled = plane.normal / plane.offset + field[[1, 2, 0]] / (rig.fx * rig.baseline_m)
    offset = float(np.sign(plane.offset) / np.linalg.norm(scaled))
    return Plane(scaled * offset, offset)


def _bars(pixels: _Pixels, rig: Rig, plane: Plane, site: Site, config: GrizzlyConfig) -> BarFit:
    sigma = np.asarray(rig.depth_sigma(pixels.depth, 0.15))
    sample = Sample(pixels.xyz, tolerances(sigma, config), pixels.area * pixels.depth**2)
    return fit_bars(sample, plane, site, sharp=True)


def _covariance(pixels: _Pixels, field: F64, weight: F64) -> F64 | None:
    """Covariance (3, 3) of a fitted field [px²], robust against errors that neighbours have in
    common: the sandwich of clusters (Liang & Zeger 1986); None where too few tell of it.
    """
    basis = pixels.rays[:, [2, 0, 1]]
    tile = np.floor(pixels.rays[:, :2] / _TILE_RAD).astype(np.intp)
    tile = np.unique(tile, axis=0, return_inverse=True)[1].ravel()
    count = int(tile.max()) + 1
    if count < _FEWEST_TILES:
        return None
    pull = weight * (pixels.excess - np.einsum("ni,i->n", basis, field))
    pulls = np.stack([np.bincount(tile, pull * column, count) for column in basis.T])
    normal = np.einsum("ni,nj->ij", basis * weight[:, None], basis)
    # Of bars that are all in one line the rest is unknown, and not singular.
    bread = np.linalg.inv(normal + 1e-9 * np.trace(normal) * np.eye(3))
    filling = np.einsum("it,jt->ij", pulls, pulls) * count / (count - 3)
    return np.asarray(np.einsum("ij,jk,kl->il", bread, filling, bread))


def _described(
    seen: _Pixels, pixels: _Pixels, rig: Rig, plane: Plane, field: F64, covariance: F64
) -> Registration:
    measured = plane_of(rig, plane, field)
    height = plane.height(seen.on(measured))
    tilt = float(np.arccos(np.clip(measured.normal @ plane.normal, -1, 1)))
    worst = float(np.percentile(np.abs(height), 99))
    px_m = float(rig.depth_sigma(np.median(seen.depth), 1.0)) * abs(float(plane.normal[2]))
    sigma = float(np.percentile(_height_sigma(pixels, rig, plane, covariance), 99))
    return Registration(field, float(np.median(height)), tilt, worst, sigma, px_m)


def _beside(moved: Registration, fit: BarFit, plane: Plane, bar: BarLine) -> Registration:
    """The registration with how far to the side of a known bar others were measured.

    Errors of disparity move points along their rays: the known one is looked at where its ray meets
    the plane measured.
    """
    combs = [bars for bars in (fit.bars, fit.cross) if bars is not None]
    bars = max(combs, key=lambda each: abs(float(each.direction @ bar.direction)))
    direction = bars.direction * np.sign(bars.direction @ bar.direction)
    turn = float(np.arcsin(np.clip(plane.normal @ np.cross(bar.direction, direction), -1, 1)))
    at = bar.point * (plane.offset / float(plane.normal @ bar.point))
    side = np.sign(bars.across @ np.cross(plane.normal, bar.direction))
    return replace(moved, slide_m=-float(side) * bars.beside(at), turn_rad=turn)


def _height_sigma(pixels: _Pixels, rig: Rig, plane: Plane, covariance: F64) -> F64:
    """Standard deviation (N,) [m] of the height of the fitted plane where rays meet it."""
    basis = pixels.rays[:, [2, 0, 1]]
    sigma_px = np.sqrt(np.einsum("ni,ij,nj->n", basis, covariance, basis))
    # A pixel of disparity moves a point by z²/(f·B) along its ray, whose length along the normal is
    # |offset| / z.
    return np.asarray(
        sigma_px
        * rig.depth_sigma(pixels.on(plane)[:, 2], 1.0)
        * abs(plane.offset)
        / pixels.on(plane)[:, 2]
    )
