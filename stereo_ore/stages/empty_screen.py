"""The empty screen in a run: where its plane is, whether the camera still stands where it did, what
is new on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_ore.config import Config
from stereo_ore.stages import cloud, grizzly, matching
from stereo_ore.types import (
    Background,
    Disparity,
    Grizzly,
    PointCloud,
    RectifiedPair,
    Region,
    Registration,
    Rig,
    Site,
    Surface,
)


@dataclass(frozen=True)
class EmptyScreen:
    """The model of the empty screen, with the bars where the site has them, and the grizzly found
    in it.

    `registration` is how far from there they were measured: the matcher's own bias, for frames to
    be rid of it as well.
    """

    background: Background
    grizzly: Grizzly
    registration: Registration | None = None


def load_empty_screen(rig: Rig, region: Region, site: Site, config: Config) -> EmptyScreen | None:
    """The site's empty screen, or None when the site names none.

    Raises
    ------
    ConfigError
        When the file can't be used, or is of another image size.
    FrameError
        When no screen is found in it.
    """
    if site.background is None:
        return None
    background = matching.background.load_background(site.background)
    matching.background.check_size(background, rig.height, rig.width)
    sure = np.where(np.isfinite(background.disparity), np.float32(1), np.float32(np.nan))
    disparity, moved = Disparity(background.disparity, region, sure), None
    if site.plane is not None:
        moved = grizzly.register(disparity, rig, site.plane, site, config.grizzly)
        disparity = grizzly.corrected(disparity, moved, rig)
        background = replace(background, disparity=disparity.values)
    found = grizzly.find(_surface(disparity, rig, site, config), site, config.grizzly)
    return EmptyScreen(
        background, found if site.plane is not None else replace(found, source="background"), moved
    )


def new_on(empty: EmptyScreen, disparity: Disparity, surface: Surface) -> Surface:
    """The surface without what the empty screen showed already.

    What hides in the shadows of its bars was not measured then; it stays, for its height to be
    judged.
    """
    height, width = surface.xyz.shape[:2]
    crop = (slice(surface.y0, surface.y0 + height), slice(surface.x0, surface.x0 + width))
    old = matching.background.shows_screen(empty.background, disparity)[crop]
    return replace(surface, xyz=np.where(old[..., None], np.float32(np.nan), surface.xyz))


def _surface(disparity: Disparity, rig: Rig, site: Site, config: Config) -> Surface:
    """The empty screen in metres; its colours were not kept."""
    black = np.zeros((rig.height, rig.width, 3), np.uint8)
    pair = RectifiedPair(black, black, rig)
    points: PointCloud = cloud.reproject(
        disparity, pair, site.volume, config.cloud, config.matching.sigma_px
    )
    return cloud.surface(points, np.ones(len(points), bool), pair, disparity.region)
