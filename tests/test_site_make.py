"""The survey of a screen, its site file, and what holds for one camera alone."""

import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from stereo_ore.calibrate.survey import differences
from stereo_ore.chain import Chain
from stereo_ore.io import calibration
from stereo_ore.io.recordings import open_source
from stereo_ore.io.site import load_site, save_site
from stereo_ore.stages.health import missing_in_site, other_scene
from stereo_ore.types import Plane, Site

SCENE = Path(__file__).parents[1] / "data" / "large_02"
CALIB = SCENE / "calibration.yaml"


def stereo_ore(*arguments: object) -> subprocess.CompletedProcess[str]:
    words = [str(word) for word in ("stereo-ore", *arguments)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site file from the demo scene, of which the arm alone was known."""
    folder = tmp_path_factory.mktemp("site")
    known = load_site(SCENE / "site.yaml")
    save_site(Site(known.T_arm_camera), folder / "arm.yaml")
    arguments = ("--calib", CALIB, "--site", folder / "arm.yaml", "--out", folder / "site.yaml")
    done = stereo_ore("site", "make", SCENE, *arguments)
    assert done.returncode == 0, done.stderr
    assert "survey.confirmed: true" in done.stdout
    return folder / "site.yaml"


def test_screen_bars_and_volume_are_found(made: Path) -> None:
    site, truth = load_site(made), load_site(SCENE / "site.yaml")
    assert site.opening_m == pytest.approx(truth.opening_m, rel=0.04)
    assert site.bar_width_m == pytest.approx(truth.bar_width_m, rel=0.1)
    assert site.plane is not None
    assert truth.plane is not None
    middle = truth.plane.normal * truth.plane.offset
    assert abs(site.plane.height(middle)) < 0.025
    assert np.degrees(np.arccos(site.plane.normal @ truth.plane.normal)) < 0.5
    assert site.volume is not None
    size = (site.volume.max_m - site.volume.min_m)[:2]
    assert np.all(size > [3.8, 3.3])
    assert np.all(size < [4.8, 4.0])
    assert np.array_equal(site.T_arm_camera, truth.T_arm_camera)
    (bars,) = (row for row in differences(truth, site) if row.what == "bars within the plane")
    assert bars.ok, bars.found


def test_a_picture_shows_what_was_found(made: Path) -> None:
    picture, left = cv2.imread(str(made.with_suffix(".png"))), cv2.imread(str(SCENE / "left.png"))
    assert picture.shape == left.shape
    assert 0.01 < (picture != left).any(2).mean() < 0.2


def test_no_target_until_a_person_has_confirmed(made: Path, tmp_path: Path) -> None:
    site, camera = load_site(made), calibration.load(CALIB)
    assert [reason.code for reason in missing_in_site(site)] == ["SITE_NOT_CONFIRMED"]
    document = yaml.safe_load(made.read_text())
    document["survey"]["confirmed"] = True
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(document))
    confirmed = load_site(tmp_path / "site.yaml")
    pair = open_source(SCENE).read(0)
    before, after = (Chain(camera, each)(pair) for each in (site, confirmed))
    assert (before.status, before.targets, len(before.ores) > 0) == ("ok", (), True)
    assert after.targets
    assert after.reasons == ()


def test_another_calibration_is_another_scene(made: Path) -> None:
    site, camera = load_site(made), calibration.load(CALIB)
    assert list(other_scene(site, camera)) == []
    moved = replace(camera, t_right_left=camera.t_right_left * 1.001)
    (reason,) = other_scene(site, moved)
    assert reason.code == "OTHER_SCENE"
    assert camera.fingerprint in reason.detail
    assert moved.fingerprint in reason.detail
    result = Chain(moved, site)(open_source(SCENE).read(0))
    assert (result.status, result.targets) == ("degraded", ())
    assert "OTHER_SCENE" in {reason.code for reason in result.reasons}


def test_a_fingerprint_is_of_the_numbers_not_of_the_file(tmp_path: Path) -> None:
    camera = calibration.load(CALIB)
    calibration.save(replace(camera, camera="another name"), tmp_path / "again.yaml")
    assert calibration.load(tmp_path / "again.yaml").fingerprint == camera.fingerprint
    other = replace(camera, disparity_offset_px=0.5)
    assert other.fingerprint != camera.fingerprint


def test_check_agrees_with_the_file_or_ends_with_3(made: Path, tmp_path: Path) -> None:
    good = stereo_ore("site", "check", SCENE / "site.yaml", SCENE, "--calib", CALIB)
    assert good.returncode == 0, good.stdout + good.stderr
    document = yaml.safe_load((SCENE / "site.yaml").read_text())
    document["grizzly"]["plane"]["offset_m"] += 0.1
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(document))
    off = stereo_ore("site", "check", tmp_path / "site.yaml", SCENE, "--calib", CALIB)
    assert off.returncode == 3
    assert "DIFFERS" in off.stdout


def test_differences_name_a_plane_that_is_off_and_a_volume_that_is_small(made: Path) -> None:
    site = load_site(made)
    assert all(row.ok for row in differences(site, site))
    assert site.plane is not None
    assert site.volume is not None
    off = replace(site, plane=Plane(site.plane.normal, site.plane.offset - 0.05))
    small = replace(site, volume=replace(site.volume, max_m=site.volume.max_m * 0.5))
    assert site.bar is not None
    assert site.bar_width_m is not None
    across = np.cross(site.plane.normal, site.bar.direction)
    slid = replace(site, bar=replace(site.bar, point=site.bar.point + 0.04 * across))
    pitch = site.opening_m + site.bar_width_m
    other = replace(site, bar=replace(site.bar, point=site.bar.point + 3 * pitch * across))
    assert [row.ok for row in differences(off, site)] == [False, True, True]
    assert [row.ok for row in differences(slid, site)] == [True, False, True]
    assert [row.ok for row in differences(small, site)] == [True, True, False]
    assert all(row.ok for row in differences(other, site))
    assert list(differences(Site(), site)) == []


def test_without_a_screen_there_is_one_line(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (720, 1280, 3), dtype=np.uint8)
    for eye in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{eye}.png"), cv2.GaussianBlur(noise, (0, 0), 2))
    done = stereo_ore("site", "make", tmp_path, "--calib", CALIB, "--out", tmp_path / "site.yaml")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert not (tmp_path / "site.yaml").exists()
