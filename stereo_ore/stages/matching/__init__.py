"""Stereo matching: a rectified pair → float disparities, and what the matcher doubts about each of
them.
"""

from stereo_ore.stages.matching import background
from stereo_ore.stages.matching.fusion import fuse
from stereo_ore.stages.matching.match import match, search_saved
from stereo_ore.stages.matching.narrow import narrow
from stereo_ore.stages.matching.region import find_region

__all__ = ["background", "find_region", "fuse", "match", "narrow", "search_saved"]
