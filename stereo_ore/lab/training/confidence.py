"""Training of the confidence of disparities on pairs with truth, faults of light and noise planted
in some.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.lab import metrics
from stereo_ore.lab.bench.stereo_sets import StereoSet
from stereo_ore.lab.training.networks import fit_network
from stereo_ore.network import Network
from stereo_ore.stages import matching
from stereo_ore.stages.matching import confidence, consistency, light, relief, sgbm
from stereo_ore.stages.matching.confidence import PIXEL_FEATURES, RIGHT_PX
from stereo_ore.stages.matching.match import evidence, grey
from stereo_ore.types import F32, U8, Mask, RectifiedPair

_PIXELS, HIDDEN, EPOCHS, _FOLDS = 8000, 16, 16, 4
"""Pixels of a view that the network learns from, its units, how often it sees each, and folds of
whole sets."""

EXPOSURE, VIGNETTING, GAMMA, _NOISE = (0.7, 1.25), 0.35, (0.8, 1.25), (1.0, 7.0)
"""Ranges of what is planted: the right eye's brightness over the left's, what is lost in the
corners, exponent of the right eye's brightness, standard deviation [grey levels] of either eye's
noise."""

_Fault = Callable[[StereoSet, np.random.Generator], RectifiedPair]


@dataclass(frozen=True)
class _View:
    """Examples of one pair: features (N, F), whether the disparity is right (N,); views of one set
    share its name.
    """

    set: str
    fault: str
    features: F32
    right: Mask


@dataclass(frozen=True)
class _Quality:
    """On a set that the network did not see: area under the ROC curve, and said and true share of
    each tenth.
    """

    set: str
    auc: float | None
    said: list[float | None]
    true: list[float | None]


def _exposure(data: StereoSet, rng: np.random.Generator) -> RectifiedPair:
    bright = data.pair.right / 255.0
    return replace(
        data.pair, right=_grey_levels(255 * rng.uniform(*EXPOSURE) * bright ** rng.uniform(*GAMMA))
    )


def _vignetting(data: StereoSet, rng: np.random.Generator) -> RectifiedPair:
    height, width = data.pair.right.shape[:2]
    y, x = (np.linspace(-1, 1, side) for side in (height, width))
    kept = (
        1
        - VIGNETTING
        * rng.uniform(0.3, 1)
        * ((x - rng.uniform(-0.5, 0.5)) ** 2 + y[:, None] ** 2)
        / 2
    )
    return replace(data.pair, right=_grey_levels(data.pair.right * kept[..., None]))


def _noise(data: StereoSet, rng: np.random.Generator) -> RectifiedPair:
    left, right = (
        _grey_levels(eye + rng.normal(0, rng.uniform(*_NOISE), eye.shape))
        for eye in (data.pair.left, data.pair.right)
    )
    return replace(data.pair, left=left, right=right)


def _none(data: StereoSet, rng: np.random.Generator) -> RectifiedPair:
    return data.pair


_FAULTS: dict[str, _Fault] = {
    "none": _none,
    "exposure": _exposure,
    "vignetting": _vignetting,
    "noise": _noise,
}


def _grey_levels(image: np.ndarray[Any, np.dtype[np.float64]]) -> U8:
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def training_views(
    sets: Iterable[StereoSet], config: MatchingConfig, seed: int = 0
) -> Iterator[_View]:
    """Examples of all sets, each as it is and with every fault planted."""
    for number, data in enumerate(sets):
        for index, (fault, plant) in enumerate(_FAULTS.items()):
            rng = np.random.default_rng([seed, number, index])
            yield _view(replace(data, pair=plant(data, rng)), fault, config, rng)


def _view(data: StereoSet, fault: str, config: MatchingConfig, rng: np.random.Generator) -> _View:
    """Some pixels that left and right match agree on and whose truth is known."""
    region = matching.narrow(data.pair, data.region, data.volume, config)
    images, compared = light.evened(
        sgbm.crop(grey(data.pair.left), grey(data.pair.right), region), config
    )
    found = consistency.match_both(images, config, compared)
    surface = relief.relief_cues(found.filled, found.valid)
    values, _, seen = evidence(images, found, confidence.context(images, found, surface))
    error = values + np.float32(region.min_disparity) - data.truth[region.slices]
    at = rng.permutation(np.flatnonzero(found.valid & np.isfinite(error)))[:_PIXELS]
    features = np.column_stack([np.ravel(feature)[at] for feature in seen])
    return _View(data.name, fault, features, np.asarray(np.abs(np.ravel(error)[at]) <= RIGHT_PX))


def train_confidence(examples: Sequence[_View], seed: int = 0) -> tuple[Network, list[_Quality]]:
    """The network of all views, and the quality of such ones on the sets that each was not shown,
    in `_FOLDS` folds.
    """
    names = sorted({view.set for view in examples})
    quality = []
    for k in range(min(_FOLDS, len(names))):
        held = set(names[k::_FOLDS])
        network = _fit([view for view in examples if view.set not in held], seed)
        for name in sorted(held):
            seen = [view for view in examples if view.set == name and view.fault == "none"]
            quality.append(_judge(name, network, seen))
    return _fit(examples, seed), quality


def _fit(examples: Sequence[_View], seed: int) -> Network:
    features = np.concatenate([view.features for view in examples])
    right = np.concatenate([view.right for view in examples])
    return fit_network(features, right, HIDDEN, EPOCHS, seed)


def _judge(name: str, network: Network, seen: Sequence[_View]) -> _Quality:
    said = np.concatenate([network.probability(view.features) for view in seen])
    right = np.concatenate([view.right for view in seen])
    return _Quality(name, metrics.area_under_roc(said, right), *metrics.reliability(said, right))


def to_json(
    network: Network, quality: Sequence[_Quality], examples: Sequence[_View], seed: int
) -> str:
    """Readable text: what it was made from, how good it is on sets left out, a row of weights a
    line.
    """
    made = {
        "made_with": "stereo-ore tune --train confidence",
        "sets": sorted({view.set for view in examples}),
        "faults": list(_FAULTS),
        "pixels": sum(len(view.right) for view in examples),
        "right": f"within {RIGHT_PX} px of the truth",
        "seed": seed,
        "auc_on_sets_left_out": {
            each.set: round(each.auc, 3) for each in quality if each.auc is not None
        },
    }
    text = json.dumps(
        {"provenance": made, "features": PIXEL_FEATURES, "network": asdict(network)}, indent=1
    )
    return text.replace(",\n    ", ", ").replace("[\n    ", "[").replace("\n   ]", "]") + "\n"
