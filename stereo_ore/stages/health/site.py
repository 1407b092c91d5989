"""Whether the site says enough for a target: what an arm strikes must not rest on a guess."""

from __future__ import annotations

from collections.abc import Iterator

from stereo_ore.types import Reason, Site

ARM = "arm_from_camera"
VOLUME = "working_volume"
PLANE = "grizzly.plane or background"


def missing(site: Site) -> Iterator[Reason]:
    """NO_ARM_FRAME, NO_VOLUME_GIVEN and NO_PLANE_GIVEN, for each that nobody gave.

    Without the transform nothing can be struck. Without volume and plane a frame can't be checked:
    the screen would be searched for in the very data that it has to judge, and the steel and walls
    around it would be ore. Ores are found all the same; they are no targets.
    """
    wanted = (
        ("NO_ARM_FRAME", ARM, site.T_arm_camera is not None),
        ("NO_VOLUME_GIVEN", VOLUME, site.volume is not None),
        ("NO_PLANE_GIVEN", PLANE, site.plane is not None or site.background is not None),
    )
    for code, key, given in wanted:
        if not given:
            yield Reason(code, f"no targets: {key} is not in the site file")
