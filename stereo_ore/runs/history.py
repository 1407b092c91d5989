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

from stereo_ore.config import Config
from stereo_ore.record import to_line
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.tracks import Tracks
from stereo_ore.threads import pool
from stereo_ore.types import U8, FrameResult, Json, Reason, Site

FEWEST_GOOD = 5
"""Good frames that are needed to say what is usual."""


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
    config : Config
        Limits (`health`), and what confirms a target (`order`).
    site : Site
        The arm's reach, for the order of targets.
    earlier : iterable of FrameLines
        Lines of the run that is continued, in order, as they were written.
    """

    def __init__(
        self, config: Config, site: Site | None = None, earlier: Iterable[FrameLines] = ()
    ) -> None:
        self._config = config.health
        self._good: deque[float] = deque(maxlen=config.health.history)
        self._images: deque[list[str]] = deque(maxlen=config.health.frozen_history)
        self._tracks = Tracks(config, site or Site())
        for lines in earlier:
            self._remember(json.loads(lines.record), _images(lines))

    def judge(self, lines: FrameLines) -> FrameLines:
        """The lines of the next frame; its record is degraded, without targets, where its
        predecessors say so, and its lumps are those of the frames before.
        """
        record = json.loads(lines.record)
        images = _images(lines)
        reasons = (
            () if record["status"] == "failed" else (*self._frozen(images), *self._fallen(record))
        )
        record = degraded(record, reasons) if reasons else self._tracks.follow(record)
        self._remember(record, images)
        return replace(lines, record=to_line(record))

    def _remember(self, record: Json, images: list[str] | None) -> None:
        if images:
            self._images.append(images)
        self._tracks.remember(record)
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
