"""Planes around each disparity: exact on planes, and steps stand off them."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.stages.matching import relief
from stereo_ore.types import RELIEF_CUES, RELIEF_WINDOWS_PX

SHAPE = (160, 200)
INSIDE = np.s_[40:-40, 40:-40]


def plane(a: float, b: float, c: float) -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return (a * x + b * y + c).astype(np.float32)


@settings(deadline=None, max_examples=25)
@given(a=st.floats(-0.2, 0.2), b=st.floats(-0.2, 0.2), c=st.floats(0, 300))
def test_on_a_plane_nothing_stands_off(a: float, b: float, c: float) -> None:
    cues = relief.relief_cues(plane(a, b, c), np.ones(SHAPE, bool))
    assert tuple(cues) == RELIEF_CUES
    for window in RELIEF_WINDOWS_PX:
        assert np.abs(cues[f"offset_{window}_px"][INSIDE]).max() < 0.01
        # A slope counts as scatter as far as it goes inside a pixel of the copy.
        assert (
            cues[f"scatter_{window}_px"][INSIDE].max()
            < 0.7 * np.hypot(a, b) * relief.REDUCTIONS[window] + 0.05
        )
        np.testing.assert_allclose(cues[f"support_{window}"][INSIDE], 1, atol=1e-5)


def test_a_patch_too_near_stands_off_the_wider_planes() -> None:
    values = plane(0.02, 0, 50)
    values[70:90, 90:110] += 6
    cues = relief.relief_cues(values, np.ones(SHAPE, bool))
    assert cues["offset_14_px"][80, 100] == pytest.approx(0, abs=0.1)
    assert cues["offset_72_px"][80, 100] > 4
    assert cues["scatter_36_px"][80, 90] > 1


def test_invalid_pixels_have_no_say_and_no_offset() -> None:
    valid = np.random.default_rng(0).random(SHAPE) < 0.6
    good = relief.relief_cues(
        np.where(valid, plane(0.05, 0.02, 40), np.nan).astype(np.float32), valid
    )
    wild = relief.relief_cues(np.where(valid, plane(0.05, 0.02, 40), 900).astype(np.float32), valid)
    for name in RELIEF_CUES:
        np.testing.assert_array_equal(good[name], wild[name])
        assert np.isfinite(good[name]).all()
    assert (good["offset_36_px"][~valid] == 0).all()
    assert np.abs(good["offset_36_px"][INSIDE]).max() < 0.15


def test_brightness_tells_which_surface_a_pixel_belongs_to() -> None:
    """A strip behind an edge was given what lies in front; it looks like what is behind."""
    grey = np.full(SHAPE, 60, np.uint8)
    grey[:, 100:] = 180
    values = np.where(grey > 100, 40, 30).astype(np.float32)
    right = values.copy()
    values[:, 97:100] = 40
    every = np.ones(SHAPE, bool)
    wrong = relief.off_alike(values, every, grey)[INSIDE]
    column = np.arange(SHAPE[1])[INSIDE[1]]
    assert wrong[:, (column >= 97) & (column < 100)].min() > 3
    assert np.abs(relief.off_alike(right, every, grey)[INSIDE]).max() < 0.5
    assert (relief.off_alike(np.zeros(SHAPE, np.float32), ~every, grey) == 0).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 5), (7, 9)])
def test_small_regions(shape: tuple[int, int]) -> None:
    for valid in (np.ones(shape, bool), np.zeros(shape, bool)):
        cues = relief.relief_cues(np.full(shape, 12, np.float32), valid)
        assert all(cue.shape == shape and np.isfinite(cue).all() for cue in cues.values())
        filled = 12 * valid.astype(np.float32)
        off = relief.off_alike(filled, valid, np.zeros(shape, np.uint8))
        assert off.shape == shape
        assert np.isfinite(off).all()


def test_threads_change_nothing() -> None:
    values, valid = plane(0.1, 0.03, 20), np.random.default_rng(1).random(SHAPE) < 0.8
    threads, found = cv2.getNumThreads(), []
    try:
        for count in (1, 4):
            cv2.setNumThreads(count)
            found.append(relief.relief_cues(values, valid))
    finally:
        cv2.setNumThreads(threads)
    for name in RELIEF_CUES:
        np.testing.assert_array_equal(found[0][name], found[1][name])
