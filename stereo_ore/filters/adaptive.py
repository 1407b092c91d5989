"""The default filter: density at several K, distance to the surface around, and the matcher's doubts."""

from __future__ import annotations

import numpy as np

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.filters.evidence import Evidence, features, gather, has_cues
from stereo_ore.filters.scorer import Scorer, load
from stereo_ore.types import F32, FilterResult, VoxelCloud


def adaptive(voxels: VoxelCloud, params: AdaptiveParams) -> FilterResult:
    """Remove points whose noise probability is above the threshold; the score is that probability.

    Neighbours are found and densities computed once (`evidence.gather`); a first pass judges by them and by the cues
    alone. Each further pass fits planes to the neighbours, weighted by how likely each is to be surface, asks how well
    the point lies on its own plane and on those of its neighbours (`surface`, and `wide` for stereo clouds), and scores
    it anew: what the pass before took for noise no longer bends the surface.
    """
    evidence = gather(voxels, params.k)
    name = "stereo" if has_cues(voxels) else "geometry"
    scorer = load(name)
    noise = run_passes(evidence, scorer)
    threshold = scorer.threshold if params.threshold is None else params.threshold
    return FilterResult(noise <= threshold, noise, {"scorer": name, "threshold": threshold})


def run_passes(evidence: Evidence, scorer: Scorer) -> F32:
    """Noise probability (M,) after all passes of a scorer."""
    if tuple(scorer.features) != evidence.names:
        raise ValueError("the scorer was trained on other features than the evidence has")
    noise = evidence.prior
    for network in scorer.passes:
        light = network.width == evidence.features.shape[1]
        noise = network.probability(evidence.features if light else features(evidence, noise))
    return np.asarray(noise, np.float32)
