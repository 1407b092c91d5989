"""The screen: the plane of the bar tops, given by the site or found in the cloud, and the bars in
it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stereo_ore.config import GrizzlyConfig
from stereo_ore.errors import FrameError
from stereo_ore.stages.grizzly.bars import BarFit, fit_bars
from stereo_ore.stages.grizzly.edges import crossing, sharpened
from stereo_ore.stages.grizzly.extent import extent, over
from stereo_ore.stages.grizzly.plane import candidate_planes, refine_plane, residual
from stereo_ore.stages.grizzly.registration import corrected, plane_of, register
from stereo_ore.stages.grizzly.sample import Sample, draw_sample, tolerances
from stereo_ore.types import Grizzly, Plane, Site, Surface

__all__ = ["corrected", "extent", "find", "over", "plane_of", "register", "with_crossing"]

MIN_POINTS = 200
CLEAR_CONTRAST = 0.25
"""Contrast of bars that need not be counted."""
MOST_ROUGH = 0.25
"""Residual of a plane [clear distances between its bars] above which noise would pass for bars."""


def find(surface: Surface, site: Site, config: GrizzlyConfig) -> Grizzly:
    """The grizzly under and around the ore.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    site : Site
        Its plane is taken as it is and only measured; without one the plane is found. A known
        opening and bar width fix the pitch of the bars, otherwise the pitch is measured too.
    config : GrizzlyConfig
        Tolerances and the seed.

    Raises
    ------
    FrameError
        No plane was given, and none in the cloud is cut into bars.
    """
    sample = draw_sample(surface, config)
    found = (
        _found(sample, site, config) if site.plane is None else _measured(sample, site, site.plane)
    )
    return _sharp(found, surface, site, config)


def _sharp(found: Grizzly, surface: Surface, site: Site, config: GrizzlyConfig) -> Grizzly:
    """The screen with the width that its bars have in the image, where nobody has measured it, and
    without bars across that neither somebody has described nor the image shows.
    """
    tolerance = tolerances(surface.sigma_z, config)
    bars, cross, diagnostics = found.bars, found.cross_bars, dict(found.diagnostics)
    if site.bar_width_m is None:
        bars = sharpened(surface, found, tolerance, site.bar_profile)
        diagnostics["bar_width_from"] = "image" if bars else "depth"
    if site.cross_opening_m is None or site.bar_width_m is None:
        across = sharpened(surface, replace(found, bars=cross), tolerance, site.bar_profile)
        cross = across or (cross if site.cross_opening_m is not None else None)
    screen = replace(found, bars=bars or found.bars, cross_bars=cross, diagnostics=diagnostics)
    return _with_openings(screen, site)


def with_crossing(screen: Grizzly, surface: Surface, site: Site, config: GrizzlyConfig) -> Site:
    """The site with the holes of a screen that only the image shows to be a grid; else as it was.

    For surveys: it takes the time of a frame. Of round bars the image shows a gleam, and flat ties
    under them more clearly: nothing is looked for.
    """
    if site.bar_profile == "round":
        return site
    if site.opening_m is not None or screen.bars is None or screen.cross_bars is not None:
        return site
    cross = crossing(surface, screen, tolerances(surface.sigma_z, config))
    if cross is None:
        return site
    width = screen.bars.width_m
    return replace(
        site,
        opening_m=screen.bars.pitch_m - width,
        cross_opening_m=cross.pitch_m - width,
        bar_width_m=width,
    )


def _with_openings(screen: Grizzly, site: Site) -> Grizzly:
    """The screen with the clear distances that the site gives, or else its bars have."""
    openings = [
        known if known is not None or bars is None else bars.pitch_m - bars.width_m
        for known, bars in (
            (site.opening_m, screen.bars),
            (site.cross_opening_m, screen.cross_bars),
        )
    ]
    return replace(screen, opening_m=openings[0], cross_opening_m=openings[1])


def _measured(sample: Sample, site: Site, plane: Plane) -> Grizzly:
    """The site's plane with its residual on the bars and how far the cloud disagrees with it."""
    if len(sample) < MIN_POINTS:
        return _grizzly(plane, "site", None, site, {"points": len(sample)})
    # Shiny bars are measured a little off; they are found in the plane that the cloud has near the
    # site's.
    near = refine_plane(sample, plane, BarFit(None, 0.0))
    fit = fit_bars(sample, near, site, sharp=True)
    rms, inliers = residual(sample, plane, fit)
    other = refine_plane(sample, near, fit)
    tilt = float(np.arccos(np.clip(other.normal @ plane.normal, -1, 1)))
    middle = np.median(sample.xyz, axis=0)
    gap = float(other.height(middle) - plane.height(middle))
    return _grizzly(
        plane,
        "site",
        rms,
        site,
        {"inlier_share": inliers, "cloud_tilt_rad": tilt, "cloud_offset_m": gap},
        fit,
    )


def _found(sample: Sample, site: Site, config: GrizzlyConfig) -> Grizzly:
    """The candidate plane that is widest and most clearly cut into bars."""
    best: tuple[float, Plane, BarFit] | None = None
    for candidate, area in candidate_planes(sample, config):
        plane = refine_plane(sample, candidate, fit_bars(sample, candidate, site))
        fit = fit_bars(sample, plane, site, sharp=True)
        score = area * fit.contrast
        if _is_screen(sample, plane, fit, site, config) and (best is None or score > best[0]):
            best = score, plane, fit
    if best is None:
        raise FrameError(
            f"no plane of bars was found among {len(sample):,} points",
            code="NO_SCREEN",
            remedy=(
                "Give grizzly.plane in the site file, or check that screen and working volume are"
                " in view"
            ),
        )
    for _ in range(config.refinements):
        plane = refine_plane(sample, best[1], best[2])
        best = best[0], plane, fit_bars(sample, plane, site, sharp=True)
    _, plane, fit = best
    rms, inliers = residual(sample, plane, fit)
    return _grizzly(plane, "auto", rms, site, {"inlier_share": inliers}, fit)


def _is_screen(
    sample: Sample, plane: Plane, fit: BarFit, site: Site, config: GrizzlyConfig
) -> bool:
    """Whether bars were seen: the less the site says of the screen, the more of them are wanted."""
    if fit.bars is None or fit.contrast < config.min_contrast:
        return False
    if site.opening_m is not None and site.bar_width_m is not None:
        return True
    if site.volume is not None:
        return fit.seen >= 2 or fit.contrast >= CLEAR_CONTRAST
    rms, _ = residual(sample, plane, fit)
    gap = fit.bars.pitch_m - fit.bars.width_m
    return fit.seen >= config.min_bars and rms is not None and rms < MOST_ROUGH * gap


def _grizzly(
    plane: Plane,
    source: Any,
    rms: float | None,
    site: Site,
    diagnostics: dict[str, Any],
    fit: BarFit | None = None,
) -> Grizzly:
    bars, cross = (fit.bars, fit.cross) if fit else (None, None)
    if fit:
        diagnostics |= {"bar_contrast": fit.contrast, "bars_seen": fit.seen}
    screen = Grizzly(plane, source, rms, bars, None, diagnostics, cross_bars=cross)
    return _with_openings(screen, site)
