"""Whether the site says enough for a target: what an arm strikes must not rest on a guess."""

from __future__ import annotations

from collections.abc import Iterator

from stereo_ore.types import Reason, Site, StereoCalibration

ARM = "arm_from_camera"
_VOLUME = "working_volume"
PLANE = "grizzly.plane or background"


def missing(site: Site) -> Iterator[Reason]:
    """NO_ARM_FRAME, NO_VOLUME_GIVEN and NO_PLANE_GIVEN, for each that nobody gave, and
    SITE_NOT_CONFIRMED for what a program found and nobody has looked at.

    Without the transform nothing can be struck. Without volume and plane a frame can't be checked:
    the screen would be searched for in the very data that it has to judge, and the steel and walls
    around it would be ore. Ores are found all the same; they are no targets.
    """
    wanted = (
        ("NO_ARM_FRAME", ARM, site.T_arm_camera is not None),
        ("NO_VOLUME_GIVEN", _VOLUME, site.volume is not None),
        ("NO_PLANE_GIVEN", PLANE, site.plane is not None or site.background is not None),
    )
    for code, key, given in wanted:
        if not given:
            yield Reason(code, f"no targets: {key} is not in the site file")
    if site.survey is not None and not site.survey.confirmed:
        yield Reason(
            "SITE_NOT_CONFIRMED",
            "no targets: survey.confirmed is false in the site file: look at its picture, correct"
            " the numbers, and set it to true",
        )


def other_scene(site: Site, calibration: StereoCalibration) -> Iterator[Reason]:
    """OTHER_SCENE where the site was surveyed with another calibration: plane and volume hold for
    one camera alone.
    """
    survey = site.survey
    if survey is not None and survey.calibration != calibration.fingerprint:
        surveyed = (
            f"{survey.calibration} ({survey.camera or 'no name'}, {_size(survey.image_size)})"
        )
        used = f"{calibration.fingerprint} ({calibration.camera or 'no name'}, "
        yield Reason(
            "OTHER_SCENE",
            f"the site was surveyed with the calibration {surveyed}, this is {used}"
            f"{_size(calibration.image_size)}): is it another camera's, or was it calibrated anew?"
            " Then survey the screen again with `stereo-ore site make`",
        )


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]}×{size[1]} px"
