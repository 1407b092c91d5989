"""What a frame lost on its way from pixel to target, and why: the answer to "why no target?"."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from stereo_ore.types import FrameResult


@dataclass(frozen=True)
class Loss:
    """How many of what a stage dropped, and why: a stable code and a sentence."""

    stage: str
    code: str
    count: int
    unit: Literal["px", "points", "voxels", "parts", "frames"]
    detail: str


def losses(result: FrameResult) -> tuple[Loss, ...]:
    """List what each stage that was reached has dropped, in the order of the chain; never a
    zero.
    """
    found = (*_matching(result), *_cloud(result), *_filter(result), *_segment(result))
    return tuple(loss for loss in found if loss.count > 0)


def _matching(result: FrameResult) -> Iterator[Loss]:
    if result.disparity is None:
        return
    told, pixels = result.disparity.diagnostics, result.counts["pixels"]
    searched, matched = (
        told.get("pixels", pixels),
        told.get("matched", result.counts["disparities"]),
    )
    detail = "outside the part of the image that can show the working volume"
    yield Loss("match", "NOT_SEARCHED", pixels - searched, "px", detail)
    yield Loss(
        "match",
        "NOT_MATCHED",
        searched - matched,
        "px",
        "no disparity: too flat, too dark or out of range",
    )
    detail = "left-right and right-left disparity differ, or too few neighbours agree"
    yield Loss("match", "INCONSISTENT", matched - result.counts["disparities"], "px", detail)
    detail = "of the frames measured together, moved against the others"
    yield Loss("match", "FRAME_REFUSED", len(told.get("refused", ())), "frames", detail)


def _cloud(result: FrameResult) -> Iterator[Loss]:
    if result.cloud is not None:
        lost = result.counts["disparities"] - result.counts["points"]
        yield Loss(
            "cloud",
            "OUTSIDE_VOLUME",
            lost,
            "px",
            "outside the working volume or beyond cloud.max_depth_m",
        )


def _filter(result: FrameResult) -> Iterator[Loss]:
    if result.filtered is not None:
        lost = result.counts["voxels"] - result.counts["kept"]
        yield Loss("filter", "NOISE", lost, "voxels", "taken for noise by filter.method")


def _segment(result: FrameResult) -> Iterator[Loss]:
    if result.ore_map is None:
        return
    told = result.ore_map.diagnostics
    detail = "smaller than segment.min_size_m or segment.min_pixels"
    yield Loss("segment", "TOO_SMALL", told.get("dropped_small", 0), "parts", detail)
    detail = "are parts of a foreign body, not lumps"
    yield Loss("segment", "FOREIGN_BODY", told.get("dropped_foreign", 0), "parts", detail)
    detail = "stand out, but do not look like a lump"
    yield Loss("segment", "UNLIKE_A_LUMP", told.get("dropped_unlike", 0), "parts", detail)
