"""Self-checks of a run: what makes a frame too doubtful to act on, each a `Reason` with a code of
its own.

Each judges one frame by itself, where the chain has reached what it needs; those that need earlier
frames are in `runs/history.py`.
"""

from stereo_ore.stages.health.detail import without_blurred
from stereo_ore.stages.health.eyes import eye_doubts as eye_doubts
from stereo_ore.stages.health.parts import judge_parts, row_doubts, without_doubtful
from stereo_ore.stages.health.screen import bar_doubts, unmeasured_doubts
from stereo_ore.stages.health.screen import screen_doubts as screen_doubts
from stereo_ore.stages.health.site import missing as missing_in_site
from stereo_ore.stages.health.site import other_scene
from stereo_ore.stages.health.tiers import tier_doubts

__all__ = [
    "bar_doubts",
    "eye_doubts",
    "judge_parts",
    "missing_in_site",
    "other_scene",
    "row_doubts",
    "screen_doubts",
    "tier_doubts",
    "unmeasured_doubts",
    "without_blurred",
    "without_doubtful",
]
