"""Search for a filter's best parameters on labelled clouds under a stated cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_ore.config import FilterConfig
from stereo_ore.config.models import StageConfig, param
from stereo_ore.errors import ConfigError
from stereo_ore.lab.bench.labelled import LabelledCloud
from stereo_ore.lab.metrics import FilterQuality, filter_quality
from stereo_ore.stages import filters

_ROUNDS = 3
SPACES: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "paper": {
        "k0": (5, 8, 10, 15, 20, 30),
        "R": (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.6, 2.0),
        "alpha": (0.0, 2.0, 5.0, 10.0, 15.0),
        "beta": (0.0, 0.5, 1.0, 2.0),
        "k_min": (3, 5, 10),
        "k_max": (20, 40, 60),
    },
    "adaptive": {"threshold": (0.2, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7, 0.8)},
    "statistical": {"k": (8, 12, 20, 30, 50), "ratio": (0.1, 0.2, 0.5, 1.0, 1.5, 2.0)},
    "radius": {"n": (4, 8, 16, 32), "spacings": (2.0, 3.0, 4.0, 5.0, 7.0)},
    "lof": {"k": (10, 20, 30, 50), "threshold": (1.05, 1.1, 1.2, 1.35, 1.5, 2.0)},
}
"""Values tried for each parameter, in the order in which they are tried."""


class CostWeights(StageConfig):
    """What a loss costs: the cost is the weighted mean of 1 − P_r, 1 − Recall and 1 − Retain
    (equation 7).
    """

    precision: float = param(1.0, "weight of good points among the removed", ge=0)
    recall: float = param(1.0, "weight of noise that stays", ge=0)
    retention: float = param(1.0, "weight of good points that are lost", ge=0)

    def cost(self, quality: FilterQuality) -> float:
        """Cost 0…1 of a quality."""
        weights = (self.precision, self.recall, self.retention)
        if not any(weights):
            raise ConfigError("all weights are zero", key="cost")
        losses = (1 - quality.precision, 1 - quality.recall, 1 - quality.retention)
        return sum(w * loss for w, loss in zip(weights, losses, strict=True)) / sum(weights)


@dataclass(frozen=True)
class Tuned:
    """The best parameters, their mean cost, and the cost along each parameter through the best
    point.
    """

    method: str
    params: dict[str, Any]
    cost: float
    curves: dict[str, list[tuple[Any, float]]]

    def config(self) -> dict[str, Any]:
        """A configuration that `run --config` and `filter` understand."""
        return {"filter": {"method": self.method, "params": self.params}}


def search_parameters(
    method: str,
    clouds: Sequence[LabelledCloud],
    weights: CostWeights,
    tick: Callable[[], None] = lambda: None,
) -> Tuned:
    """Coordinate descent over the method's `SPACES`: each parameter in turn takes its best value,
    until none changes.

    Parameters
    ----------
    method : str
        A key of `SPACES`.
    clouds : sequence of LabelledCloud
    weights : CostWeights
    tick : callable
        Called after each setting that was tried.
    """
    if method not in SPACES:
        raise ConfigError(f"{method!r} can't be tuned; {', '.join(SPACES)} can", key="--method")
    defaults = filters.parameters(FilterConfig(method=method)).model_dump()
    best = {key: defaults[key] for key in SPACES[method]}
    tried: dict[tuple[Any, ...], float] = {}

    def cost(params: dict[str, Any]) -> float:
        key = tuple(params.values())
        if key not in tried:
            tried[key] = _mean_cost(method, params, clouds, weights)
            tick()
        return tried[key]

    curves: dict[str, list[tuple[Any, float]]] = {}
    for _ in range(_ROUNDS):
        before = dict(best)
        for name, values in SPACES[method].items():
            curves[name] = [(value, cost({**best, name: value})) for value in values]
            best[name] = min(curves[name], key=lambda item: item[1])[0]
        if best == before:
            break
    return Tuned(method, best, cost(best), curves)


def _mean_cost(
    method: str, params: dict[str, Any], clouds: Sequence[LabelledCloud], weights: CostWeights
) -> float:
    config = FilterConfig(method=method, params=params)
    costs = [
        weights.cost(filter_quality(c.is_noise, ~filters.apply(c.voxels, config).keep))
        for c in clouds
    ]
    return sum(costs) / len(costs)


def plot(tuned: Tuned, path: Path) -> None:
    """Draw the cost along each parameter; the dot is the value taken."""
    from stereo_ore.draw.figures import save_figure
    from stereo_ore.draw.filter_pictures import panels

    figure, axes = panels(len(tuned.curves), maps=False)
    for ax, (name, curve) in zip(axes, tuned.curves.items(), strict=True):
        values, costs = zip(*curve, strict=True)
        ax.plot(values, costs, marker=".")
        ax.plot([tuned.params[name]], [dict(curve)[tuned.params[name]]], "o")
        ax.set_xlabel(name)
        ax.set_ylabel("cost")
    figure.suptitle(f"{tuned.method}: cost {tuned.cost:.4f}")
    save_figure(figure, path)
