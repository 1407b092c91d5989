"""The survey of a screen: where its bars are, and the working volume over it, from a recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from stereo_ore.config import CloudConfig, Config
from stereo_ore.errors import FrameError
from stereo_ore.stages import cloud, grizzly, matching
from stereo_ore.transforms import frame_from_normal
from stereo_ore.types import (
    F64,
    BarLine,
    Bars,
    Disparity,
    Grizzly,
    Plane,
    RectifiedPair,
    Site,
    Surface,
    Volume,
)

NEARER = (1.0, 0.8, 0.6, 0.4)
"""Shares of the points, from the nearest on, in which a screen is looked for."""
REFINEMENTS = 3
"""Times the plane found is measured again on its bars."""
BELOW, _ABOVE = 0.5, 4.0
"""Depth and height of the working volume about the bar tops, in openings."""


PLANE_OPENINGS, PLANE_DEG = 0.1, 1.5
"""How far a site's plane may be from the one surveyed."""
_BEYOND = 1.25
"""How far the surveyed screen may reach out of a site's volume [openings]: it is seen with what of
its frame lies in the bars' plane."""


@dataclass(frozen=True)
class _Survey:
    """What was found: the site with plane, opening, width and volume; the screen; how many frames
    it is from; and the last pair, to show it in.
    """

    site: Site
    screen: Grizzly
    frames: int
    pair: RectifiedPair


def survey(
    pairs: Iterable[RectifiedPair], site: Site, config: Config, height_m: float | None = None
) -> _Survey:
    """Find the screen in pairs of a still scene.

    Parameters
    ----------
    pairs
        Of one rig, the emptier the screen the better; at least one.
    site : Site
        What is known: an opening and a width that were measured on the screen itself, the arm;
        in its volume the screen is looked for. Plane and volume are found anew.
    config : Config
        Parameters of matching, cloud and screen.
    height_m : float, optional
        Height of the working volume over the bars; without it `_ABOVE` openings.

    Raises
    ------
    FrameError
        NO_SCREEN where no plane of bars is seen.
    """
    known = replace(site, plane=None, background=None)
    disparities: list[Disparity] = []
    pair: RectifiedPair | None = None
    for pair in pairs:
        region = matching.find_region(pair.rig, None, config.matching)
        region = matching.narrow(pair, region, None, config.matching)
        disparities.append(matching.match(pair, region, config.matching))
    if pair is None:
        raise FrameError("the recording has no frame", code="NO_SCREEN")
    middle = matching.background.build_background(disparities).disparity
    still = replace(disparities[0], values=middle)
    found = _refined(still, pair, known, config, height_m)
    return _Survey(found[0], found[1], len(disparities), pair)


def _refined(
    disparity: Disparity, pair: RectifiedPair, known: Site, config: Config, height_m: float | None
) -> tuple[Site, Grizzly]:
    """The screen found, and its plane then measured on the bars as each frame of a run does."""
    screen = _first(disparity, pair, known, config)
    surface = _surface(disparity, pair, known, config)
    known = grizzly.with_crossing(screen, surface, known, config.grizzly)
    site = _site(surface, screen, known, config, height_m)
    for _ in range(REFINEMENTS):
        assert site.plane is not None, "a screen has one"
        moved = grizzly.register(disparity, pair.rig, site.plane, site, config.grizzly)
        if moved is None:
            break
        plane = grizzly.plane_of(pair.rig, site.plane, moved.field_px)
        screen = grizzly.find(surface, replace(site, plane=plane), config.grizzly)
        site = _site(surface, screen, known, config, height_m)
    return site, screen


def _first(disparity: Disparity, pair: RectifiedPair, known: Site, config: Config) -> Grizzly:
    """The plane that is most clearly cut into bars, among what is nearer than each of some depths:
    a hall's floor and walls are wider planes than a screen.
    """
    seen = _surface(disparity, pair, known, config).xyz[..., 2]
    seen = seen[np.isfinite(seen)]
    found, fault = [], FrameError("nothing is measured in the recording", code="NO_SCREEN")
    for depth in np.quantile(seen, NEARER) if len(seen) else ():
        near = config.model_copy(update={"cloud": CloudConfig(max_depth_m=float(depth))})
        try:
            surface = _surface(disparity, pair, known, near)
            found.append(grizzly.find(surface, known, config.grizzly))
        except FrameError as error:
            fault = error
    if not found:
        raise fault
    return max(found, key=_clearness)


def _clearness(screen: Grizzly) -> float:
    told = screen.diagnostics
    return float(told["bar_contrast"] * told["bars_seen"])


def _surface(disparity: Disparity, pair: RectifiedPair, site: Site, config: Config) -> Surface:
    points = cloud.reproject(disparity, pair, site.volume, config.cloud, config.matching.sigma_px)
    return cloud.surface(points, np.ones(len(points), bool), pair, disparity.region)


def _site(
    surface: Surface, screen: Grizzly, known: Site, config: Config, height_m: float | None
) -> Site:
    """The site with this screen, and a volume over all of it that is seen."""
    reach = grizzly.extent(surface, screen, config.grizzly)
    bars = screen.bars
    if reach is None or bars is None:
        raise FrameError(
            "no bars are seen in the plane that was found",
            code="NO_SCREEN",
            remedy="Give --opening-m and --bar-width-m as measured on the screen",
        )
    opening = screen.opening_m or bars.pitch_m - bars.width_m
    T, half = _screen_from_camera(screen.plane, bars, reach.low, reach.high)
    top = height_m if height_m is not None else _ABOVE * opening
    volume = Volume(T, np.array([*-half, -BELOW * opening]), np.array([*half, top]))
    return replace(
        known,
        plane=screen.plane,
        opening_m=opening,
        cross_opening_m=screen.cross_opening_m or known.cross_opening_m,
        bar_width_m=bars.width_m,
        volume=volume,
        bar=_middle_bar(screen.plane, bars, T),
    )


def _middle_bar(plane: Plane, bars: Bars, T_screen_camera: F64) -> BarLine:
    """The bar nearest to the middle of the screen, at its point there."""
    middle = -T_screen_camera[:3, :3].T @ T_screen_camera[:3, 3]
    point = middle - bars.beside(middle) * bars.across
    # The plane was fitted once more after the bars.
    return BarLine(point - float(plane.height(point)) * plane.normal, bars.direction)


def _screen_from_camera(plane: Plane, bars: Bars, low: F64, high: F64) -> tuple[F64, F64]:
    """``T_screen_camera``, x across the bars, y along them, z up, the origin in the middle of the
    screen; and half its size (2,) [m].
    """
    # The plane was fitted once more after the bars: their direction lies nearly in it.
    R = frame_from_normal(plane.normal, bars.across)
    middle = (low + high) / 2
    sign = np.sign(R[1] @ bars.direction)
    at = R[0] * (bars.phase_m + middle[0]) + R[1] * sign * middle[1]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ (at + plane.normal * plane.offset)
    return T, (high - low) / 2


@dataclass(frozen=True)
class Difference:
    """What a site file says, what was found, and whether they agree."""

    what: str
    given: str
    found: str
    ok: bool


def differences(given: Site, found: Site) -> Iterator[Difference]:
    """Compare what a site says of the screen with a survey of it; nothing for what it does not say.

    The plane may be off by a tenth of an opening in the middle of the screen, as frames may
    (`health.max_bar_shift`), and by 1.5°; the volume must hold the screen that
    is seen, to `_BEYOND` openings.
    """
    opening = found.opening_m
    assert opening is not None, "a survey has an opening"
    assert found.volume is not None, "and a volume"
    T, half = found.volume.T_box_camera, found.volume.max_m[:2]
    corners = np.array([(x, y, 0.0) for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    corners = (corners - T[:3, 3]) @ T[:3, :3]
    if given.plane is not None and found.plane is not None:
        off = float(given.plane.height(corners.mean(0)))
        tilt = float(np.degrees(np.arccos(np.clip(given.plane.normal @ found.plane.normal, -1, 1))))
        ok = abs(off) < PLANE_OPENINGS * opening and tilt < PLANE_DEG
        place = f"{1000 * off:+.0f} mm and {tilt:.2f}° off"
        yield Difference("plane of the bar tops", "0 mm and 0°", place, ok)
    if given.bar is not None and found.bar is not None and found.cross_opening_m is None:
        yield _bar_difference(given.bar, found)
    if given.volume is not None:
        inside = corners + _BEYOND * opening * _inwards(corners)
        held = int(given.volume.contains(inside).sum())
        yield Difference("corners in the working volume", "4", str(held), held == len(corners))


def _bar_difference(given: BarLine, found: Site) -> Difference:
    """Of two bars, which may be different ones of the screen."""
    bar, opening, width = found.bar, found.opening_m, found.bar_width_m
    assert bar is not None, "a survey has bars"
    assert opening is not None, "and an opening"
    assert width is not None, "and their width"
    across = float(np.linalg.norm(np.cross(bar.direction, given.point - bar.point)))
    off = abs(across - (opening + width) * round(across / (opening + width)))
    sine = float(np.linalg.norm(np.cross(given.direction, bar.direction)))
    turn = float(np.degrees(np.arcsin(min(1.0, sine))))
    ok = off < PLANE_OPENINGS * opening and turn < PLANE_DEG
    place = f"{1000 * off:.0f} mm and {turn:.2f}° off"
    return Difference("bars within the plane", "0 mm and 0°", place, ok)


def _inwards(corners: F64) -> F64:
    """Unit vectors (N, 3) from corners towards their middle."""
    towards = corners.mean(0) - corners
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))
