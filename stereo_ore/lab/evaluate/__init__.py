"""Judge run folders against scenes whose truth is known exactly (`synth` writes such scenes)."""

from stereo_ore.lab.evaluate.pairs import Pair, find_pairs
from stereo_ore.lab.evaluate.score import score
from stereo_ore.lab.evaluate.summary import pool, table
from stereo_ore.lab.evaluate.truth import Truth, load_truth, must_be_found

__all__ = ["Pair", "Truth", "find_pairs", "load_truth", "must_be_found", "pool", "score", "table"]
