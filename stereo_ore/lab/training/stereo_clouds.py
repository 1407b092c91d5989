"""Labelled stereo clouds to learn from: real pairs with truth, in good and in bad light, and made
scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from zlib import crc32

import numpy as np

from stereo_ore.lab.bench.labelled import LabelledCloud, made_stereo, scene_stereo
from stereo_ore.lab.bench.real_stereo import WAYS, altered, real_cloud
from stereo_ore.lab.bench.stereo_sets import StereoSet

_FAMILIES = ("large", "paper", "hard", "large", "raw", "paper")


def stereo_clouds(
    sets: Sequence[StereoSet], scenes: Sequence[Path], seeds: range
) -> Iterator[LabelledCloud]:
    """Each real set as it is and altered in all `WAYS`, scene folders, and made scenes of all
    families in turn.
    """
    for found in sets:
        yield real_cloud(found)
        rng = np.random.default_rng(crc32(found.name.encode()))
        yield from (real_cloud(altered(found, way, rng), f"{found.name}, {way}") for way in WAYS)
    yield from map(scene_stereo, scenes)
    for n, seed in enumerate(seeds):
        # Every fifth at HD1080.
        yield made_stereo(seed, _FAMILIES[n % len(_FAMILIES)], "HD1080" if n % 5 == 4 else "HD720")


def count_scenes(sets: Sequence[StereoSet], scenes: Sequence[Path], seeds: range) -> int:
    """How many clouds `stereo_clouds` makes."""
    return len(sets) * (1 + len(WAYS)) + len(scenes) + len(seeds)
