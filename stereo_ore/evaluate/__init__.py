"""Judge run folders against scenes whose truth is known exactly (`synth` writes such scenes)."""

from stereo_ore.evaluate.pairs import Pair, find_pairs
from stereo_ore.evaluate.score import score
from stereo_ore.evaluate.summary import pool, table
from stereo_ore.evaluate.truth import MIN_PIXELS, MIN_VISIBLE, Truth, load_truth

__all__ = ["MIN_PIXELS", "MIN_VISIBLE", "Pair", "Truth", "find_pairs", "load_truth", "pool", "score", "table"]
