"""The filters that are compared, and the grid of settings from which each baseline gets the best on
every cloud.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from stereo_ore.config import FilterConfig
from stereo_ore.lab.metrics import FilterQuality, filter_quality
from stereo_ore.stages import filters
from stereo_ore.types import Mask, VoxelCloud


@dataclass(frozen=True)
class Contender:
    """A filter with its settings to try: every set of parameters with every threshold on the score.

    Without thresholds it runs as shipped.
    """

    label: str
    method: str
    grid: tuple[dict[str, Any], ...] = field(default=({},))
    thresholds: tuple[float, ...] = ()

    @property
    def tuned(self) -> bool:
        """True when it gets the best of a grid on the cloud it is judged by."""
        return bool(self.thresholds)

    def removed(self, voxels: VoxelCloud) -> list[tuple[str, Mask]]:
        """What each setting removes, with the setting in words."""
        out = []
        for params in self.grid:
            result = filters.apply(voxels, FilterConfig(method=self.method, params=params))
            words = ", ".join(f"{key} {value}" for key, value in params.items())
            if not self.tuned:
                out.append((words or "as shipped", ~result.keep))
            out += [
                (f"{words}, score > {t}".lstrip(", "), result.score > t) for t in self.thresholds
            ]
        return out

    def best(
        self, voxels: VoxelCloud, is_noise: Mask, rows: slice | Mask = slice(None)
    ) -> tuple[str, FilterQuality, Mask]:
        """The setting with the highest F1, its quality (equation 7) and what it removes, all of
        some rows.
        """
        decided = [(words, removed[rows]) for words, removed in self.removed(voxels)]
        judged = [(words, filter_quality(is_noise, removed), removed) for words, removed in decided]
        return max(judged, key=lambda item: item[1].f1)


CONTENDERS = (
    Contender(
        "radius",
        "radius",
        tuple({"n": n, "spacings": 1.0} for n in (4, 8, 16, 32)),
        (2.0, 3.0, 5.0, 7.0),
    ),
    Contender(
        "statistical", "statistical", tuple({"k": k} for k in (10, 20, 50)), (0.2, 0.5, 1.0, 2.0)
    ),
    Contender("LOF", "lof", tuple({"k": k} for k in (10, 20, 50)), (1.1, 1.2, 1.35, 1.5, 2.0)),
    Contender(
        "paper's LOF, tuned",
        "paper",
        tuple({"k0": k} for k in (5, 10, 20)),
        (1.05, 1.1, 1.2, 1.3, 1.5, 2.0),
    ),
    Contender("paper (R = 1)", "paper"),
    Contender("paper-tuned", "paper-tuned"),
    Contender("adaptive", "adaptive"),
)
"""Baselines first; the last three run with one shipped setting everywhere."""
