"""A shift between measured disparity and depth (`disparity_offset_px`, different principal points)
is respected from the search to the ores; so is the limit of depth."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import quarter_scene

from stereo_ore.chain import Chain
from stereo_ore.config import CloudConfig, Config
from stereo_ore.io.calibration import load
from stereo_ore.io.site import load_site
from stereo_ore.types import FrameResult, Site, StereoCalibration, StereoPair


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    quarter_scene(folder)
    return folder


def follow(
    scene: Path, shift_px: int, calibration: StereoCalibration, config: Config | None = None
) -> FrameResult:
    """The scene with its right picture moved by a whole number of pixels."""
    left, right = (cv2.imread(str(scene / f"{eye}.png")) for eye in ("left", "right"))
    moved = np.zeros_like(right)
    columns = np.arange(right.shape[1])
    inside = (columns - shift_px >= 0) & (columns - shift_px < right.shape[1])
    moved[:, columns[inside]] = right[:, columns[inside] - shift_px]
    site: Site = load_site(scene / "site.yaml")
    return Chain(calibration, site, config)(StereoPair(left, moved))


def places(result: FrameResult) -> np.ndarray:
    assert result.ores, result.reasons
    return np.array([ore.surface_centroid for ore in result.ores])


@pytest.mark.parametrize("shift", [-20, 24, 60])
@pytest.mark.parametrize("way", ["disparity_offset_px", "principal points"])
def test_ores_stay_where_they_are(shift: int, way: str, scene: Path) -> None:
    """+60 px leaves no disparity above zero: what lies at infinity is measured at −60."""
    calibration = load(scene / "calibration.yaml")
    expected = places(follow(scene, 0, calibration))
    if way == "disparity_offset_px":
        shifted = replace(calibration, disparity_offset_px=float(shift))
    else:
        x, y = calibration.right.principal_point_px
        eye = replace(calibration.right, principal_point_px=(x + shift, y))
        shifted = replace(calibration, right=eye)
    found = places(follow(scene, shift, shifted))
    for place in expected:
        assert np.linalg.norm(found - place, axis=1).min() < 0.03


def test_the_depth_limit_is_named_where_it_empties_the_cloud(scene: Path) -> None:
    near = Config(cloud=CloudConfig(max_depth_m=0.3))
    (*_, reason) = follow(scene, 0, load(scene / "calibration.yaml"), near).reasons
    assert reason.code == "NO_POINTS"
    assert reason.detail.startswith("cloud.max_depth_m: all points are farther than 0.3 m;")
