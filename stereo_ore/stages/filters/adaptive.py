"""The default filter: density at several K, distance to the surface around, and the matcher's
doubts.
"""

from __future__ import annotations

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.errors import ConfigError
from stereo_ore.network import Network
from stereo_ore.stages.filters import stereo
from stereo_ore.stages.filters.evidence import Evidence, bare_evidence
from stereo_ore.stages.filters.scorer import Scorer, load_scorer, read
from stereo_ore.threads import map_rows
from stereo_ore.types import F32, FilterResult, VoxelCloud


def adaptive(voxels: VoxelCloud, params: AdaptiveParams) -> FilterResult:
    """Remove points whose noise probability is above the threshold; the score is that probability.

    A stereo cloud is judged by the matcher's cues first, and by its neighbours where those leave a
    doubt; a bare one by its neighbours alone (`stereo.StereoEvidence`, `evidence.BareEvidence`).
    Each pass weighs neighbours by how likely the pass before found each to be surface: what it took
    for noise no longer bends the planes fitted to them.
    """
    name, evidence = evidence_of(voxels, params.k)
    scorer = load_scorer(name) if params.scorer is None else read(params.scorer)
    noise = run_passes(evidence, scorer)
    threshold = scorer.decide(noise) if params.threshold is None else params.threshold
    return FilterResult(noise <= threshold, noise, {"scorer": name, "threshold": threshold})


def evidence_of(voxels: VoxelCloud, k: int) -> tuple[str, Evidence]:
    """The kind of a cloud, which is its scorer's name, and its evidence from k neighbours."""
    if stereo.has_cues(voxels):
        return "stereo", stereo.stereo_evidence(voxels, k)
    return "geometry", bare_evidence(voxels.xyz, k)


def run_passes(evidence: Evidence, scorer: Scorer) -> F32:
    """Noise probability (M,) after all passes of a scorer."""
    if tuple(scorer.features) != evidence.names:
        remedy = "Fit it anew with tune --train geometry, or stereo for clouds of a matcher"
        raise ConfigError(
            "it was fitted to other features", key="filter.params.scorer", remedy=remedy
        )
    noise = evidence.prior
    for number, network in enumerate(scorer.passes):
        noise = judge_pass(evidence, noise, network, number)
    return noise


def judge_pass(evidence: Evidence, noise: F32, network: Network, number: int) -> F32:
    """Noise probabilities (M,) after pass `number`; what was decided before stays."""
    asked = evidence.ask(noise, number)
    after = noise.copy()
    if len(asked.rows):
        told = network.given(asked.whole)
        after[asked.rows] = map_rows(lambda part: told.judge(asked.table(part)), len(asked.rows))
    return after
