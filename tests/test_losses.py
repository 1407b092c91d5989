"""What a frame lost: every step from pixel to target adds up, and no loss is without a reason."""

import pytest
from golden import ROOT

import stereo_ore as so
from stereo_ore.losses import losses
from stereo_ore.types import FrameResult

SCENE = ROOT / "data" / "paper_03"


@pytest.fixture(scope="module")
def frame() -> FrameResult:
    (pair,) = so.open_recording(SCENE)
    return so.Detector.load(SCENE / "calibration.yaml", SCENE / "site.yaml")(pair).frame


def test_pixels_and_voxels_add_up(frame: FrameResult) -> None:
    lost = {loss.code: loss.count for loss in losses(frame)}
    counts = frame.counts
    searched = ("NOT_SEARCHED", "NOT_MATCHED", "INCONSISTENT")
    assert counts["pixels"] - sum(lost.get(code, 0) for code in searched) == counts["disparities"]
    assert counts["disparities"] - lost["OUTSIDE_VOLUME"] == counts["points"]
    assert counts["voxels"] - lost["NOISE"] == counts["kept"]
    assert min(lost.values()) > 0


def test_losses_are_told_in_the_order_of_the_chain(frame: FrameResult) -> None:
    stages = [loss.stage for loss in losses(frame)]
    assert stages == sorted(stages, key=("match", "cloud", "filter", "segment").index)


def test_what_was_not_reached_has_lost_nothing() -> None:
    nothing = FrameResult("f", 0, None, "failed", (), dict.fromkeys(("pixels", "disparities"), 0))
    assert losses(nothing) == ()
