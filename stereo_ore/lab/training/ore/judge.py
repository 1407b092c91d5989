"""How good a network is on examples that it never saw, and the model of whole lumps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_ore.config import SegmentConfig
from stereo_ore.lab import metrics
from stereo_ore.lab.training.ore.examples import Example
from stereo_ore.stages.segment import FEWEST, outputs, votes, whole
from stereo_ore.stages.segment.outline import renumbered
from stereo_ore.types import F32, F64, I32, U8, Mask

_Network = Callable[[F32], F32]
"""Raw outputs (5, h, w) of channels (C, h, w)."""

WANTED, _CLOSE = 60, 2
"""Pixels of a lump that must be found; lumps at most so far apart [px] touch."""
GOOD = 0.5
"""Overlap with a true lump from which on a label is one."""
_KINDS = ("alone", "beside others", "mostly within others")


@dataclass(frozen=True)
class Named:
    """The labels that a network gives in an example, their features, and what they overlap.

    `overlap` (lumps, labels) is that of every true lump with every label.
    """

    labels: I32
    features: F64
    lumps: tuple[int, ...]
    overlap: F64

    @property
    def good(self) -> Mask:
        """Which labels (n,) are a true lump."""
        best = self.overlap.max(0, initial=0) >= GOOD
        return np.asarray(best, np.bool_)


def named(network: _Network, example: Example, config: SegmentConfig) -> Named:
    """Labels as the chain would give them, before those that are no whole lump are dropped."""
    x = example.x.astype(np.float32)
    x[4] = x[4] > 0.5
    said = outputs.read(network(x))
    found = votes.lumps(
        said, FEWEST, config.ore_probability, config.agreement, config.line_probability
    )
    labels = renumbered(found, np.arange(int(found.max(initial=0)) + 1) > 0)
    lumps = tuple(int(i) for i in np.unique(example.lump) if i)
    ids = list(range(1, int(labels.max(initial=0)) + 1))
    overlap = metrics.iou_matrix(example.lump.astype(np.int32), labels, lumps, ids)
    return Named(labels, whole.features(labels, said, x), lumps, overlap)


def fit_whole(rows: Sequence[Named]) -> dict[str, Any]:
    """The model of whole lumps, as an entry of a card, fitted to labels of unseen examples."""
    from sklearn.linear_model import LogisticRegression

    features = np.concatenate([r.features for r in rows])
    good = np.concatenate([r.good for r in rows])
    mean, spread = features.mean(0), features.std(0) + 1e-6
    model = LogisticRegression(C=1.0, max_iter=2000).fit((features - mean) / spread, good)
    return {
        "features": whole.FEATURES,
        "mean": _rounded(mean),
        "spread": _rounded(spread),
        "weight": _rounded(model.coef_[0]),
        "bias": _rounded(model.intercept_)[0],
    }


def _rounded(values: F64) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def ore_quality(
    rows: Iterable[tuple[Example, Named]], model: whole.Whole | None, limit: float
) -> dict[str, Any]:
    """Recall, false labels, mean overlap, and recall by how lumps lie, over examples."""
    wanted, given, false, overlaps = 0, 0, 0, []
    kinds = {kind: [0, 0] for kind in _KINDS}
    for example, row in rows:
        keep = model.probability(row.features) > limit if model else np.ones(len(row.features)) > 0
        overlap = row.overlap[:, keep]
        pairs = dict(metrics.best_pairs(overlap))
        given += int(keep.sum())
        false += int(keep.sum()) - sum(bool(overlap[i, j] >= GOOD) for i, j in pairs.items())
        for i, kind in _wanted(example, row.lumps):
            found = float(overlap[i, pairs[i]]) if i in pairs else 0.0
            overlaps.append(found)
            wanted += 1
            kinds[kind][0] += int(found >= GOOD)
            kinds[kind][1] += 1
    found = sum(o >= GOOD for o in overlaps)
    return {
        "lumps": wanted,
        "recall": round(found / max(wanted, 1), 3),
        "false": round(false / max(given, 1), 3),
        "overlap": round(float(np.mean(overlaps)) if overlaps else 0.0, 3),
        "recall by kind": {k: f"{hit} of {n}" for k, (hit, n) in kinds.items()},
    }


def _wanted(example: Example, lumps: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Rows of the lumps that must be found, each with how it lies."""
    import cv2

    lump: U8 = example.lump
    for row, number in enumerate(lumps):
        mine = (lump == number).astype(np.uint8)
        ys, xs = np.nonzero(mine)
        rim = ys.min() == 0 or xs.min() == 0
        rim = rim or ys.max() == lump.shape[0] - 1 or xs.max() == lump.shape[1] - 1
        if len(ys) < WANTED or rim:
            continue
        ring = cv2.dilate(mine, np.ones((2 * _CLOSE + 1,) * 2, np.uint8)) > mine
        others = float((lump[ring] > 0).mean())
        yield row, _KINDS[0 if others < 0.25 else 1 if others < 0.6 else 2]
