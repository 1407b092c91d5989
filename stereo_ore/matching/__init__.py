"""Stereo matching: a rectified pair → float disparities, and what the matcher doubts about each of them."""

from stereo_ore.matching.match import match
from stereo_ore.matching.narrow import narrow
from stereo_ore.matching.region import find_region

__all__ = ["find_region", "match", "narrow"]
