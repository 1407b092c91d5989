"""The default filter: density at several K, distance to the surface around, and the matcher's doubts."""

from __future__ import annotations

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.network import Network
from stereo_ore.stages.filters import stereo
from stereo_ore.stages.filters.evidence import Evidence, gather
from stereo_ore.stages.filters.scorer import Scorer, load
from stereo_ore.types import F32, FilterResult, VoxelCloud


def adaptive(voxels: VoxelCloud, params: AdaptiveParams) -> FilterResult:
    """Remove points whose noise probability is above the threshold; the score is that probability.

    A stereo cloud is judged by the matcher's cues first, and by its neighbours where those leave a doubt; a bare one by
    its neighbours alone (`stereo.StereoEvidence`, `evidence.BareEvidence`). Each pass weighs neighbours by how likely
    the pass before found each to be surface: what it took for noise no longer bends the planes fitted to them.
    """
    name, evidence = look(voxels, params.k)
    scorer = load(name)
    noise = run_passes(evidence, scorer)
    threshold = scorer.threshold if params.threshold is None else params.threshold
    return FilterResult(noise <= threshold, noise, {"scorer": name, "threshold": threshold})


def look(voxels: VoxelCloud, k: int) -> tuple[str, Evidence]:
    """The kind of a cloud, which is its scorer's name, and its evidence from k neighbours."""
    if stereo.has_cues(voxels):
        return "stereo", stereo.gather(voxels, k)
    return "geometry", gather(voxels.xyz, k)


def run_passes(evidence: Evidence, scorer: Scorer) -> F32:
    """Noise probability (M,) after all passes of a scorer."""
    if tuple(scorer.features) != evidence.names:
        raise ValueError("the scorer was trained on other features than the evidence has")
    noise = evidence.prior
    for number, network in enumerate(scorer.passes):
        noise = judge(evidence, noise, network, number)
    return noise


def judge(evidence: Evidence, noise: F32, network: Network, number: int) -> F32:
    """Noise probabilities (M,) after pass `number`; what was decided before stays."""
    rows = evidence.undecided(noise)
    after = noise.copy()
    if len(rows):
        after[rows] = network.probability(evidence.features(noise, rows, number))
    return after
