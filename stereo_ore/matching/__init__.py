"""Stereo matching: a rectified pair → float disparities, and what the matcher doubts about each of them."""

from stereo_ore.matching import background
from stereo_ore.matching.fusion import fuse
from stereo_ore.matching.match import match, search_saved
from stereo_ore.matching.narrow import narrow
from stereo_ore.matching.region import find_region

__all__ = ["background", "find_region", "fuse", "match", "narrow", "search_saved"]
