"""Fusion of still frames and the model of the empty screen."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.config import MatchingConfig
from stereo_ore.errors import ConfigError, FrameError
from stereo_ore.stages import matching
from stereo_ore.stages.matching import background
from stereo_ore.types import Background, Disparity, RectifiedPair, Region

FRAMES = 8


def noisy(pair: RectifiedPair, seed: int, sigma: float = 4.0) -> RectifiedPair:
    rng = np.random.default_rng(seed)
    eyes = [
        np.clip(eye + rng.normal(0, sigma, eye.shape), 0, 255).astype(np.uint8)
        for eye in (pair.left, pair.right)
    ]
    return RectifiedPair(*eyes, pair.rig)


def region_of(pair: RectifiedPair) -> Region:
    return Region(0, 0, pair.rig.width, pair.rig.height, 0, 64)


@pytest.fixture(scope="module")
def frames(flat_plane_pair) -> tuple[list[RectifiedPair], list[Disparity]]:
    pairs = [noisy(flat_plane_pair.pair, seed) for seed in range(FRAMES)]
    return pairs, [matching.match(pair, region_of(pair), MatchingConfig()) for pair in pairs]


def plane_noise(disparity: Disparity, pair: RectifiedPair) -> float:
    """Root mean square distance from the best plane of inverse depth over the middle of the
    image."""
    window = slice(60, 260), slice(120, 400)
    v, u = np.mgrid[window]
    d = disparity.values[window]
    good = np.isfinite(d)
    A = np.stack([u[good], v[good], np.ones(good.sum())], 1)
    residual = d[good] - A @ np.linalg.lstsq(A, d[good], rcond=None)[0]
    return float(np.sqrt((residual[np.abs(residual) < 1] ** 2).mean()))


def test_eight_still_frames_cut_the_noise_on_a_plane(frames) -> None:
    pairs, disparities = frames
    fused = matching.fuse(pairs, disparities)
    single = np.mean([plane_noise(disparity, pairs[0]) for disparity in disparities])
    assert single / plane_noise(fused, pairs[0]) >= 2.5
    assert fused.diagnostics["fused"] == FRAMES
    assert fused.diagnostics["refused"] == []
    assert fused.diagnostics["support"] > 7
    assert set(fused.cues) == set(disparities[0].cues)


def test_outliers_of_single_frames_do_not_pull_the_mean(frames) -> None:
    pairs, disparities = frames
    values = disparities[3].values + np.float32(9)
    spoilt = [*disparities[:3], replace(disparities[3], values=values), *disparities[4:]]
    a, b = (matching.fuse(pairs, d).values for d in (disparities, spoilt))
    assert np.nanmax(np.abs(a - b)) < 0.5
    assert np.nanmedian(np.abs(a - b)) < 0.02


def test_a_pixel_that_half_the_frames_miss_has_no_disparity(frames) -> None:
    pairs, disparities = frames
    holes = []
    for i, disparity in enumerate(disparities):
        values = disparity.values.copy()
        if i < FRAMES // 2:
            values[100:120, 200:220] = np.nan
        holes.append(replace(disparity, values=values))
    fused = matching.fuse(pairs, holes)
    assert np.isnan(fused.values[100:120, 200:220]).all()
    assert np.isfinite(fused.values[140:160, 200:220]).mean() > 0.95


def test_a_moving_frame_is_refused_and_named(frames) -> None:
    pairs, disparities = frames
    lefts = [pair.left for pair in pairs]
    lefts[5] = lefts[5].copy()
    lefts[5][140:200, 200:260] = np.roll(lefts[5], 25, 1)[140:200, 200:260]
    fused = matching.fuse(
        [replace(pair, left=left) for pair, left in zip(pairs, lefts, strict=True)], disparities
    )
    assert fused.diagnostics["refused"] == [5]
    assert fused.diagnostics["fused"] == FRAMES - 1


def test_a_moving_camera_is_an_error(frames) -> None:
    pairs, disparities = frames
    lefts = [np.roll(pair.left, 3 * i, 1) for i, pair in enumerate(pairs)]
    with pytest.raises(FrameError, match="moved") as caught:
        matching.fuse(
            [replace(pair, left=left) for pair, left in zip(pairs, lefts, strict=True)], disparities
        )
    assert caught.value.code == "MOVING_SCENE"


def test_flicker_of_the_light_is_not_motion(frames) -> None:
    pairs, disparities = frames
    lefts = [
        np.clip(pair.left * (0.9 + 0.02 * i), 0, 255).astype(np.uint8)
        for i, pair in enumerate(pairs)
    ]
    assert (
        matching.fuse(
            [replace(pair, left=left) for pair, left in zip(pairs, lefts, strict=True)], disparities
        ).diagnostics["refused"]
        == []
    )


def test_one_frame_fused_is_that_frame(frames) -> None:
    pairs, disparities = frames
    fused = matching.fuse(pairs[:1], disparities[:1])
    np.testing.assert_array_equal(fused.values, disparities[0].values)


@pytest.fixture(scope="module")
def empty(frames) -> Background:
    return background.build_background(frames[1])


def test_the_empty_screen_is_as_on_its_frames(frames, empty: Background) -> None:
    assert empty.frames == FRAMES
    assert abs(background.compare(empty, frames[1][0])) < 0.1
    both = np.isfinite(empty.disparity) & np.isfinite(frames[1][0].values)
    assert background.shows_screen(empty, frames[1][0])[both].mean() > 0.99


def test_what_stands_before_the_empty_screen_is_found(frames, empty: Background) -> None:
    values = frames[1][1].values.copy()
    values[100:200, 200:300] += 3
    disparity = replace(frames[1][1], values=values)
    mask = background.shows_screen(empty, disparity)
    assert not mask[100:200, 200:300].any()
    both = np.isfinite(empty.disparity) & np.isfinite(values)
    both[100:200, 200:300] = False
    assert mask[both].mean() > 0.99
    assert not mask[~np.isfinite(empty.disparity)].any()
    assert abs(background.compare(empty, disparity)) < 0.1


@pytest.mark.parametrize("shift", [-2.0, 0.6, 4.0])
def test_a_moved_camera_is_an_error_not_garbage(shift: float, frames, empty: Background) -> None:
    moved = replace(frames[1][2], values=frames[1][2].values + np.float32(shift))
    with pytest.raises(FrameError, match="moved") as caught:
        background.compare(empty, moved)
    assert caught.value.code == "CAMERA_MOVED"


def test_a_turned_camera_is_an_error(frames, empty: Background) -> None:
    turned = cv2.warpAffine(
        frames[1][2].values,
        cv2.getRotationMatrix2D((240, 160), 20, 1),
        (480, 320),
        borderValue=float("nan"),
    )
    with pytest.raises(FrameError, match="moved"):
        background.compare(empty, replace(frames[1][2], values=turned))


def test_models_of_another_size_and_no_frames_are_refused(frames, empty: Background) -> None:
    small = Background(empty.disparity[:100], empty.sigma[:100], 1)
    with pytest.raises(ConfigError, match=r"480×100 px.*480×320 px"):
        background.compare(small, frames[1][0])
    with pytest.raises(ConfigError, match="no frame"):
        background.build_background([])


def test_a_model_survives_its_file(tmp_path: Path, empty: Background) -> None:
    path = tmp_path / "empty_screen.npz"
    background.save_background(empty, path)
    again = background.load_background(path)
    np.testing.assert_array_equal(again.disparity, empty.disparity)
    np.testing.assert_array_equal(again.sigma, empty.sigma)
    assert again.frames == empty.frames
    assert [p.name for p in tmp_path.iterdir()] == ["empty_screen.npz"]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04torn", b"not a zip"])
def test_broken_model_files_are_named(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"model\.npz"):
        background.load_background(path)
    with pytest.raises(ConfigError, match=r"absent\.npz"):
        background.load_background(tmp_path / "absent.npz")


def test_foreign_and_pickled_archives_are_refused(tmp_path: Path) -> None:
    foreign, pickled = tmp_path / "foreign.npz", tmp_path / "pickled.npz"
    np.savez(foreign, a=np.zeros(3))
    np.savez(pickled, format=np.array({"a": 1}, dtype=object), allow_pickle=True)
    for path in (foreign, pickled):
        with pytest.raises(ConfigError, match="empty screen"):
            background.load_background(path)
