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
from stereo_ore.runs.tracks import USABLE, Tracks
from stereo_ore.threads import pool
from stereo_ore.types import F64, U8, FrameResult, Json, Reason, Site

FEWEST_GOOD = 5
"""Good frames that are needed to say what is usual."""
_NOISES = 2.0
"""Standard deviations of a frame's registration that are no drift."""


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
        self._bars_first: list[F64] = []
        self._bars_last: deque[F64] = deque(maxlen=config.health.history)
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
        record = _remarked(record, self._drifted(record))
        return replace(lines, record=to_line(record))

    def _remember(self, record: Json, images: list[str] | None) -> None:
        if images:
            self._images.append(images)
        self._tracks.remember(record)
        if record["status"] in USABLE:
            self._good.append(_valid_share(record))
            if (bars := _bars_off(record)) is not None:
                self._bars_last.append(bars)
                if len(self._bars_first) < self._config.history:
                    self._bars_first.append(bars)

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

    def _drifted(self, record: Json) -> Iterator[Reason]:
        """SCREEN_DRIFTS where the last frames have the bars elsewhere than the first, beyond noise.

        Each frame is corrected; but somebody should look why that is.
        """
        if record["status"] not in USABLE or _bars_off(record) is None:
            return
        if len(self._bars_first) < FEWEST_GOOD or len(self._bars_last) < FEWEST_GOOD:
            return
        first, last = (np.median(bars, 0) for bars in (self._bars_first, list(self._bars_last)))
        opening_m = record["grizzly"]["openings_m"][0]
        change = float(np.abs(last[:2] - first[:2]).max())
        if change > max(self._config.max_bar_drift * opening_m, _NOISES * last[2]):
            text = f"the bars are {1000 * change:.0f} mm from where the first frames had them"
            remedy = "it is corrected, but does the camera or the screen come loose?"
            yield Reason("SCREEN_DRIFTS", f"{text} (health.max_bar_drift): {remedy}")

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


def _bars_off(record: Json) -> F64 | None:
    """How far the bars were measured from their place: in the median, at most, and the deviation of
    this [m]; None where they or their opening are not known.
    """
    grizzly = record["grizzly"] or {}
    moved = grizzly.get("registration")
    if not (moved and grizzly["openings_m"]):
        return None
    return np.array([moved[key] for key in ("offset_m", "worst_m", "sigma_m")])


def _remarked(record: Json, remarks: Iterable[Reason]) -> Json:
    """The record with reasons that take no target away."""
    new = [{"code": reason.code, "detail": reason.detail} for reason in remarks]
    return record | {"reasons": record["reasons"] + new} if new else record


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
