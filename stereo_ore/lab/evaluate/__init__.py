"""Judge run folders against scenes whose truth is known exactly (`synth` writes such scenes)."""

from stereo_ore.lab.evaluate.pairs import TruthPair, find_pairs
from stereo_ore.lab.evaluate.score import score
from stereo_ore.lab.evaluate.summary import pool_scenes, summary_table
from stereo_ore.lab.evaluate.truth import Truth, load_truth, must_be_found

__all__ = [
    "Truth",
    "TruthPair",
    "find_pairs",
    "load_truth",
    "must_be_found",
    "pool_scenes",
    "score",
    "summary_table",
]
