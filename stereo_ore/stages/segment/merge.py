"""Parts of one lump put together again, and parts that are no lump taken out."""

from __future__ import annotations

import numpy as np

from stereo_ore.stages.segment.features import Scene, join, measure, pair_features, part_features
from stereo_ore.stages.segment.weights import Logistic
from stereo_ore.types import F64, I32

ROUNDS = 12


def merge_parts(scene: Scene, labels: I32, limit: float, model: Logistic) -> I32:
    """Join neighbouring parts whose probability of being one lump exceeds the limit.

    In each round those pairs are joined that are the best of both partners, and the features are
    measured again.
    """
    if labels.max(initial=0) < 2:
        return labels
    parts = measure(scene, labels)
    for _ in range(ROUNDS):
        pairs = parts.pairs
        same = model.probability(pair_features(scene, parts))
        best = np.zeros(len(parts.name))
        for end in pairs.T:
            np.maximum.at(best, end, same)
        join_now = (same > limit) & (same >= best[pairs[:, 0]]) & (same >= best[pairs[:, 1]])
        if not join_now.any():
            break
        into = np.arange(len(best), dtype=np.int32)
        into[pairs[join_now, 1]] = pairs[join_now, 0]
        parts = join(parts, into)
    return parts.name[labels]


def lump_probability(scene: Scene, labels: I32, model: Logistic) -> F64:
    """Probability (n + 1,) that each part 0…n is a lump and not a wrong match, rubble or steel; 0
    for label 0.
    """
    out = model.probability(part_features(scene, labels))
    out[0] = 0.0
    return out
