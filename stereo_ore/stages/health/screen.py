"""Whether the screen lies where the site says: else the camera was moved, or the calibration is
wrong.

Bars are the widest plane in the cloud, so what makes disparities wrong (a shift of one eye's
columns, another baseline or focal length) lifts, sinks or turns this plane. It is blind to what
moves the plane within itself: the camera slid along the screen, or turned about its normal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config import GrizzlyConfig, HealthConfig
from stereo_ore.stages.grizzly.bars import BarFit
from stereo_ore.stages.grizzly.plane import candidate_planes, refine_plane
from stereo_ore.stages.grizzly.sample import Sample, draw_sample, tolerances
from stereo_ore.types import F64, Mask, Plane, Reason, Registration, Surface

_FEWEST_POINTS = 200
_WIDE = 0.7
"""Spread of a plane's points over that of all points, below which it may be the face of a rock."""
_CLEARER = 1.5
"""So many times the points near the site's plane a plane elsewhere must have to be believed."""
_OVERLAP = 5.0
"""Planes nearer than this [standard deviations of a depth] share points: one of them can't be much
clearer."""

_LEAST_OPEN, _GRID = 0.12, 20_000
"""Share of a screen's outline, on a grid of so many pixels, that shows no bar and no ore: a bed of
ore has no gaps."""
LEAST_HIDDEN = 0.4
"""Share of the outline of all points that shows any where ore hides the screen; less where only
tips of it are left."""
_SURELY, _UNSURE = 2.0, 3.0
"""Standard deviations of the bars' plane by which it must be too far off, and which must be less
than how far off it may be."""
LEAST_OWN, CLEAR_OF, _BESIDE = 0.05, 2.5, 2.5
"""The bars are at the site's plane after all where at least this share of the points is, so many
times more than so many tolerances above and below: then a wider plane is the floor of the pit."""


@dataclass(frozen=True)
class Deviation:
    """How the plane that the cloud shows differs from the site's.

    offset_m along the site's normal, in the middle of its points; tilt_rad; and the same that noise
    alone may make: sigma_m of one depth, sigma_rad of a plane that is off by sigma_m at the edge of
    its points.
    """

    offset_m: float
    tilt_rad: float
    sigma_m: float
    sigma_rad: float


def screen_doubts(
    surface: Surface, plane: Plane, grizzly: GrizzlyConfig, config: HealthConfig
) -> Iterator[Reason]:
    """SCREEN_MOVED where the cloud shows the screen elsewhere, or neither it nor a bed of ore that
    hides it.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    plane : Plane
        The site's plane of the bar tops.
    grizzly : GrizzlyConfig
        Tolerances and seed of the search for planes.
    config : HealthConfig
        The limits.
    """
    sample = draw_sample(surface, grizzly)
    if len(sample) < _FEWEST_POINTS:
        return
    found = deviation(surface, sample, plane, grizzly, config.least_screen)
    if found is None:
        seen = np.isfinite(surface.xyz[..., 2])
        if seen.sum() < LEAST_HIDDEN * _outline(seen).sum() and not _stays(sample, plane):
            text = "neither is a screen seen at grizzly.plane, nor ore that hides it"
            yield Reason(
                "SCREEN_MOVED",
                f"{text}: was the camera moved, or is the calibration of another one?",
            )
        return
    farthest = config.max_screen_offset * found.sigma_m
    steepest = max(config.max_screen_tilt_rad, found.sigma_rad)
    # Together: of a screen that sinks out of the working volume only what is highest is seen, a
    # little low and turned.
    if np.hypot(found.offset_m / farthest, found.tilt_rad / steepest) > 1:
        where = (
            f"{1000 * abs(found.offset_m):.0f} mm {'above' if found.offset_m > 0 else 'below'}"
            " grizzly.plane"
        )
        limits = (
            f"allowed are {1000 * farthest:.0f} mm or {np.degrees(steepest):.1f}°, less of both"
            " together"
        )
        text = (
            f"the screen is seen {where} and turned by {np.degrees(found.tilt_rad):.1f}°, {limits}"
        )
        yield Reason(
            "SCREEN_MOVED", f"{text}: was the camera moved, or is the calibration of another one?"
        )


def bar_doubts(
    moved: Registration | None, opening_m: float | None, config: HealthConfig
) -> Iterator[Reason]:
    """SCREEN_MOVED where the bars were surely measured farther from their place than may be
    corrected, or to its side, which can't be; SCREEN_UNSURE where they don't tell of it.

    Their whole plane counts, which thousands of pixels tell to millimetres, not the noise of one
    depth; of few bars at one end it says little about the other.
    """
    if moved is None or opening_m is None:
        return
    # Where a pixel is large the matcher's own bias is, too.
    most = max(config.max_bar_shift * opening_m, config.max_bar_shift_px * moved.px_m)
    if moved.worst_m > most + _SURELY * moved.sigma_m:
        where = (
            f"{1000 * abs(moved.offset_m):.0f} mm {'above' if moved.offset_m > 0 else 'below'}"
            " their place"
        )
        text = f"the bars are measured {where}, turned by {np.degrees(moved.tilt_rad):.2f}°"
        limit = f"up to {1000 * moved.worst_m:.0f} mm off, {1000 * most:.0f} mm may be corrected"
        remedy = "was the camera moved, or is the calibration of another one?"
        yield Reason("SCREEN_MOVED", f"{text} and {limit} (health.max_bar_shift): {remedy}")
    elif _beside(moved, most, config):
        text = f"the bars are measured {1000 * abs(moved.slide_m or 0):.0f} mm beside their place"
        turn = f"turned by {np.degrees(moved.turn_rad or 0):.2f}° in the screen"
        limits = f"{1000 * most:.0f} mm and {np.degrees(config.max_bar_turn_rad):.1f}° may be"
        keys = "(health.max_bar_shift, health.max_bar_turn_rad)"
        remedy = "was the camera or the screen moved, or is the calibration of another one?"
        yield Reason("SCREEN_MOVED", f"{text}, {turn}; {limits} {keys}: {remedy}")
    elif _UNSURE * moved.sigma_m > most:
        text = f"what is seen of the bars tells their plane to {1000 * moved.sigma_m:.0f} mm only"
        yield _unsure(text, most / _UNSURE)


def _beside(moved: Registration, most_m: float, config: HealthConfig) -> bool:
    """Whether the bars lie beside the one that the site knows, or run in another direction."""
    if moved.slide_m is None or moved.turn_rad is None:
        return False
    return abs(moved.slide_m) > most_m or abs(moved.turn_rad) > config.max_bar_turn_rad


def unmeasured_doubts(
    surface: Surface,
    plane: Plane,
    opening_m: float,
    grizzly: GrizzlyConfig,
    config: HealthConfig,
) -> Iterator[Reason]:
    """SCREEN_UNSURE where one sees through the screen and yet no bars were measured, unless the
    check by single depths is sharp enough.

    Under a bed of ore nothing of it is to be seen, and nothing is said.
    """
    if not np.isfinite(surface.sigma_z).any():
        return
    told, most = (
        config.max_screen_offset * _sigma_m(surface, plane),
        config.max_bar_shift * opening_m,
    )
    if told > most and _open_share(surface, plane, grizzly) >= _LEAST_OPEN:
        text = "one sees through the screen, but its bars can't be measured, and single depths tell"
        yield _unsure(f"{text} its place to {1000 * told:.0f} mm only", most)


def _unsure(text: str, wanted_m: float) -> Reason:
    wanted = f"{1000 * wanted_m:.0f} mm are wanted (health.max_bar_shift)"
    remedy = "is the lens dirty, the light poor, or the screen too far for this camera?"
    return Reason("SCREEN_UNSURE", f"{text}, {wanted}: {remedy}")


def deviation(
    surface: Surface, sample: Sample, plane: Plane, config: GrizzlyConfig, least_share: float
) -> Deviation | None:
    """How far the clearest plane of the cloud is from `plane`; None where no plane is clear."""
    planes = [
        refine_plane(sample, plane, BarFit(None, 0.0))
        for plane, _ in candidate_planes(sample, config)
    ]
    wide = [candidate for candidate in planes if _is_wide(sample, candidate, least_share)]
    if not wide:
        return None
    seen = max(wide, key=lambda candidate: _share(sample, candidate))
    if _open_share(surface, seen, config) < _LEAST_OPEN:
        return None
    on = _on(sample, seen)
    found = _deviation(sample.xyz[on], seen, plane, surface)
    overlaps = abs(found.offset_m) < _OVERLAP * found.sigma_m
    clearer = on.mean() > _CLEARER * _share(sample, plane)
    return found if overlaps or (clearer and not _stays(sample, plane)) else None


def _stays(sample: Sample, plane: Plane) -> bool:
    """Whether the bars are at the site's plane after all, whatever else is seen."""
    near = _share(sample, plane)
    return near > LEAST_OWN and near > CLEAR_OF * _share_beside(sample, plane)


def _on(sample: Sample, plane: Plane) -> Mask:
    return np.asarray(np.abs(plane.height(sample.xyz)) < sample.tolerance)


def _is_wide(sample: Sample, plane: Plane, least_share: float) -> bool:
    """Whether a plane has points enough, over much of what is seen."""
    on = _on(sample, plane)
    return bool(on.mean() >= least_share and _spread(sample.xyz[on]) >= _WIDE * _spread(sample.xyz))


def _open_share(surface: Surface, plane: Plane, config: GrizzlyConfig) -> float:
    """Share of the pixels within the outline of the plane's points that show nothing on it or
    above.
    """
    step = max(1, int(np.sqrt(surface.xyz[..., 2].size / _GRID)))
    height = plane.height(surface.xyz[::step, ::step])
    tolerance = tolerances(surface.sigma_z[::step, ::step], config)
    on = np.abs(height) < tolerance
    if not on.any():
        return 0.0
    inside = _outline(on)
    return float((inside & ~(height > -tolerance)).sum() / inside.sum())


def _outline(shown: Mask) -> Mask:
    """The convex hull of what is shown."""
    hull = cv2.convexHull(np.argwhere(shown)[:, ::-1].astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(np.zeros(shown.shape, np.uint8), hull, 1) > 0)


def _share(sample: Sample, plane: Plane) -> float:
    return float(_on(sample, plane).mean())


def _share_beside(sample: Sample, plane: Plane) -> float:
    """The greater share of points on the planes a little above and below."""
    step = _BESIDE * float(np.median(sample.tolerance))
    return max(_share(sample, Plane(plane.normal, plane.offset + side * step)) for side in (-1, 1))


def _spread(xyz: F64) -> float:
    """Root mean square distance [m] of points (N, 3) from their centre."""
    return float(np.sqrt(((xyz - xyz.mean(0)) ** 2).sum(1).mean()))


def _deviation(xyz: F64, seen: Plane, plane: Plane, surface: Surface) -> Deviation:
    middle = xyz.mean(0)
    sigma = _sigma_m(surface, plane)
    tilt = float(np.arccos(np.clip(seen.normal @ plane.normal, -1, 1)))
    return Deviation(float(plane.height(middle)), tilt, sigma, sigma / _spread(xyz))


def _sigma_m(surface: Surface, plane: Plane) -> float:
    """Standard deviation [m] of the height of one depth over the plane, in the middle of them all.

    A disparity's noise moves a point along its ray; what of that is along the normal is offset / z.
    """
    share = surface.sigma_z / surface.xyz[..., 2]
    share = share[np.isfinite(share)]
    half = len(share) // 2
    return float(np.partition(share, half)[half]) * abs(plane.offset)
