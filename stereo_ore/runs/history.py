"""What only a frame's predecessors tell: an image that is not new, a view that has become worse,
what was in the air.

An ordered fold over the lines of a run, in the parent process: the same records come out for any
number of workers, and a run that is continued starts from what was written before.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from stereo_ore.config import HealthConfig
from stereo_ore.record import to_line
from stereo_ore.runs.folder import FrameLines
from stereo_ore.threads import pool
from stereo_ore.types import F64, U8, FrameResult, Json, Reason

FEWEST_GOOD = 5
"""Good frames that are needed to say what is usual."""
SAME_M, SAME_SHARE = 0.03, 0.03
"""A lump is one of the frame before when the middles of what is seen are this near, or this share
of the distance."""


def fingerprints(result: FrameResult) -> list[str] | None:
    """A short digest of the pixels of each eye; None for a frame without images."""
    pair = result.pair
    return None if pair is None else list(pool().map(_digest, (pair.left, pair.right)))


def _digest(image: U8) -> str:
    return hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=8).hexdigest()


class Watch:
    """Judges each frame of a run by those before it.

    Parameters
    ----------
    config : HealthConfig
        Limits.
    earlier : iterable of FrameLines
        Lines of the run that is continued, in order, as they were written.
    """

    def __init__(self, config: HealthConfig, earlier: Iterable[FrameLines] = ()) -> None:
        self._config = config
        self._good: deque[float] = deque(maxlen=config.history)
        self._images: deque[list[str]] = deque(maxlen=config.frozen_history)
        self._lumps = np.empty((0, 3))
        for lines in earlier:
            self._remember(json.loads(lines.record), _images(lines))

    def judge(self, lines: FrameLines) -> FrameLines:
        """The lines of the next frame; its record is degraded, without targets, where its
        predecessors say so.
        """
        read = record = json.loads(lines.record)
        images = _images(lines)
        reasons = (
            () if record["status"] == "failed" else (*self._frozen(images), *self._fallen(record))
        )
        if reasons:
            record = degraded(record, reasons)
        elif self._config.confirm:
            record = _confirmed(record, self._lumps)
        if record is not read:
            lines = replace(lines, record=to_line(record))
        self._remember(record, images)
        return lines

    def _remember(self, record: Json, images: list[str] | None) -> None:
        if images:
            self._images.append(images)
        if self._config.confirm:
            self._lumps = _middles(record)
        if record["status"] in ("ok", "empty"):
            self._good.append(_valid_share(record))

    def _frozen(self, images: list[str] | None) -> Iterator[Reason]:
        if not (self._config.refuse_frozen and images):
            return
        for ago, earlier in enumerate(reversed(self._images), 1):
            same = [
                eye
                for eye, new, old in zip(("left", "right"), images, earlier, strict=True)
                if new == old
            ]
            if same:
                before = "the frame before" if ago == 1 else f"the frame {ago} before"
                text = (
                    f"the image of the {' and of the '.join(same)} eye is that of {before}, pixel"
                    " for pixel"
                )
                yield Reason("FRAME_FROZEN", f"{text}: does the camera still deliver?")
                return

    def _fallen(self, record: Json) -> Iterator[Reason]:
        if len(self._good) < FEWEST_GOOD:
            return
        share, usual = _valid_share(record), median(self._good)
        if share < self._config.min_of_usual * usual:
            text = (
                f"{100 * share:.0f} % of the pixels have a disparity, {100 * usual:.0f} % are usual"
            )
            yield Reason(
                "VALID_SHARE_FELL", f"{text}: is there dirt on a lens, dust, or a lamp out?"
            )


def _images(lines: FrameLines) -> list[str] | None:
    images: list[str] | None = json.loads(lines.inputs).get("images")
    return images


def _valid_share(record: Json) -> float:
    counts = record["counts"]
    return float(counts["disparities"] / max(counts["pixels"], 1))


def _middles(record: Json) -> F64:
    """Middles of what is seen of the lumps (N, 3) [m]."""
    return np.array([ore["surface_centroid"]["camera"] for ore in record["ores"]], float).reshape(
        -1, 3
    )


def _confirmed(record: Json, before: F64) -> Json:
    """The record without targets that the frame before did not show: what flies is elsewhere in
    each.
    """
    new = [
        id
        for id, middle in zip((ore["id"] for ore in record["ores"]), _middles(record), strict=True)
        if not (np.linalg.norm(before - middle, axis=1) < max(SAME_M, SAME_SHARE * middle[2])).any()
    ]
    if not set(new) & set(record["targets"]):
        return record
    reason = {
        "code": "NOT_CONFIRMED",
        "detail": "the frame before shows no lump here (health.confirm)",
    }
    ores = [
        ore | {"reasons": [*ore["reasons"], reason]} if ore["id"] in new else ore
        for ore in record["ores"]
    ]
    targets = [id for id in record["targets"] if id not in new]
    return record | {
        "ores": ores,
        "targets": targets,
        "counts": record["counts"] | {"targets": len(targets)},
    }


def degraded(record: Json, reasons: Iterable[Reason]) -> dict[str, Any]:
    """The record without targets, for further reasons."""
    new = [{"code": reason.code, "detail": reason.detail} for reason in reasons]
    counts = record["counts"] | {"targets": 0}
    return record | {
        "status": "degraded",
        "reasons": record["reasons"] + new,
        "counts": counts,
        "targets": [],
    }
