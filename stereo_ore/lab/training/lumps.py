"""Training of what segmentation has learned, on scenes whose lumps are known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.chain import Chain
from stereo_ore.config import Config, FilterConfig, SegmentConfig
from stereo_ore.io import recordings
from stereo_ore.lab import evaluate, metrics, synth
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.synth.model import FIRST_LUMP
from stereo_ore.lab.training.networks import fit_network
from stereo_ore.network import Network
from stereo_ore.stages import segment
from stereo_ore.stages.segment.features import join, measure, pair_features, part_features
from stereo_ore.stages.segment.merge import merge_parts
from stereo_ore.stages.segment.outline import filled
from stereo_ore.stages.segment.pixels import candidates, pixel_features
from stereo_ore.stages.segment.view import measure_view
from stereo_ore.stages.segment.weights import PAIR_FEATURES, PART_FEATURES, Logistic, Weights
from stereo_ore.types import (
    F32,
    F64,
    I32,
    U8,
    Grizzly,
    Mask,
    Site,
    StereoCalibration,
    StereoPair,
    Surface,
    Volume,
)

THRESHOLDS = (None, 0.25, 0.5)
"""Noise probabilities of the filter at which each scene is seen; None: the filter's own, with a
screen given by the site, with one whose bars alone are given, and with one found."""

FAMILIES = ("large", "paper", "hard", "raw")
SIZES = ("HD720", "VGA", "HD720", "VGA", "HD1080")
CROWD = 8
"""Lumps at least on a crowded screen, of which there are three in seven: more of them touch. Two in
nine are empty, and a third has angular lumps."""
PIXELS, HIDDEN, EPOCHS = 1500, 16, 12
"""Pixels of a view that the network learns from, its units, and how often it sees each pixel."""
PURE = 0.6
"""Share of a part that must belong to one lump, or to none, for the part to be an example."""

FOLDS = 5
FOLDER_WEIGHT = 4.0
"""A scene folder counts as so many synthetic scenes: those are there to be many, folders to be like
the real thing."""


@dataclass(frozen=True)
class View:
    """A scene as segmentation is given it, with the true labels (H, W), lumps from 2 on, and those
    to be found.

    `weight` is what its examples count in training.
    """

    scene: str
    surface: Surface
    grizzly: Grizzly
    volume: Volume | None
    instance: I32
    wanted: tuple[int, ...]
    weight: float = 1.0


@dataclass(frozen=True)
class Examples:
    """Features (N, F), truths (N,) and weights (N,): a scene counts as the root of its examples,
    times its weight.
    """

    features: F64
    truth: Mask
    weight: F64

    @classmethod
    def of(
        cls, features: Sequence[F64], truth: Sequence[Mask], width: int, weight: float
    ) -> Examples:
        """Gather what was found in parts of one scene; `width` features each."""
        rows = np.concatenate([np.zeros((0, width)), *features])
        each = np.full(len(rows), weight / np.sqrt(max(len(rows), 1)))
        return cls(rows, np.concatenate([np.zeros(0, bool), *truth]), each)


@dataclass(frozen=True)
class Quality:
    """Lumps wanted and found (overlap of at least a half), ores given and false ones, mean overlap
    of those wanted.
    """

    wanted: int
    found: int
    given: int
    false: int
    iou: float

    def __str__(self) -> str:
        recall, false = self.found / max(self.wanted, 1), self.false / max(self.given, 1)
        return (
            f"recall {recall:.3f}, false {false:.3f}, mean IoU {self.iou:.3f} ({self.wanted} lumps)"
        )


def made_views(seed: int) -> Iterator[View]:
    """Views of a synthetic scene; consecutive seeds take families and image sizes in turn."""
    spec = synth.sample_spec(seed, FAMILIES[seed % len(FAMILIES)], SIZES[seed % len(SIZES)])
    if seed % 7 < 3:
        spec = replace(spec, lumps=CROWD + seed % CROWD)
    if seed % 9 < 2:
        spec = replace(spec, lumps=0)
    spec = replace(spec, angular=seed % 3 == 0)
    made = synth.scene(spec)
    wanted = tuple(
        lump.id
        for lump in made.lumps
        if evaluate.must_be_found(lump.visible_pixels_rectified, lump.visible_fraction, lump.cut)
    )
    yield from _views(made.spec.name, made.pair, made.calibration, made.site, made.instance, wanted)


def scene_views(folder: Path) -> Iterator[View]:
    """Views of a scene folder with truth."""
    truth = evaluate.load_truth(folder)
    calibration, site = load_rig(folder)
    pair = recordings.open_source(folder).read(0)
    for view in _views(folder.name, pair, calibration, site, truth.instance, tuple(truth.wanted)):
        yield replace(view, weight=FOLDER_WEIGHT)


def _views(
    name: str,
    pair: StereoPair,
    calibration: StereoCalibration,
    site: Site,
    instance: I32,
    wanted: tuple[int, ...],
) -> Iterator[View]:
    bars_known = replace(site, plane=None)
    places = site, bars_known, replace(bars_known, opening_m=None, bar_width_m=None)
    for threshold in THRESHOLDS:
        params = {} if threshold is None else {"threshold": threshold}
        for place in places[:1] if params else places:
            result = Chain(calibration, place, Config(filter=FilterConfig(params=params)))(pair)
            if result.surface is not None and result.grizzly is not None:
                yield View(name, result.surface, result.grizzly, place.volume, instance, wanted)


def train(views: Sequence[View], config: SegmentConfig, seed: int = 0) -> tuple[Weights, Quality]:
    """Fit the network of pixels, then the models of pairs of parts that are one lump and of parts
    that are a lump.

    Each sees what those before it, fitted without its scene, make of a view, as it will on new
    scenes. The quality is that on scenes that none of them saw, in `FOLDS` folds by scene.
    """
    rng = np.random.default_rng(seed)
    fold, pixels = _folds(views), [_pixels(view, config, rng) for view in views]
    networks = [
        _network([p for p, f in zip(pixels, fold, strict=True) if f != k] or pixels)
        for k in range(FOLDS)
    ]
    seen = [Seen(view, int(f), networks[f]) for view, f in zip(views, fold, strict=True)]
    pairs = [_pairs_of(s, config, rng) for s in seen]
    pair, part = _fitted(pairs, seen, config)
    return Weights(_network(pixels), pair, part), _cross_validated(pairs, seen, config)


@dataclass(frozen=True)
class Seen:
    """A view, its fold, and the network of pixels that was fitted without that fold."""

    view: View
    fold: int
    network: Network


def _cross_validated(
    pairs: Sequence[Examples], seen: Sequence[Seen], config: SegmentConfig
) -> Quality:
    found = []
    for k in range(FOLDS):
        others = [i for i, s in enumerate(seen) if s.fold != k]
        held = [s for s in seen if s.fold == k]
        if held and others:
            models = _fitted([pairs[i] for i in others], [seen[i] for i in others], config)
            found += [judge(s.view, config, Weights(s.network, *models)) for s in held]
    return _pooled(found)


def judge(view: View, config: SegmentConfig, weights: Weights) -> Quality:
    """Quality of the segmentation of one view."""
    labels = segment.segment(view.surface, view.grizzly, view.volume, config, weights).labels
    given = list(range(1, int(labels.max(initial=0)) + 1))
    lumps = sorted({int(i) for i in np.unique(view.instance) if i >= FIRST_LUMP})
    iou = metrics.iou_matrix(view.instance, labels, lumps, given)
    best = dict(metrics.best_pairs(iou))
    overlap = [
        iou[row, best[row]] if row in best else 0.0
        for row, lump in enumerate(lumps)
        if lump in view.wanted
    ]
    hit = {column for row, column in best.items() if iou[row, column] >= 0.5}
    mean = float(np.mean(overlap)) if overlap else np.nan
    return Quality(
        len(overlap), int(np.sum(np.array(overlap) >= 0.5)), len(given), len(given) - len(hit), mean
    )


def _pooled(found: Sequence[Quality]) -> Quality:
    wanted, hit, given, false = (
        sum(getattr(q, name) for q in found) for name in ("wanted", "found", "given", "false")
    )
    return Quality(
        wanted,
        hit,
        given,
        false,
        float(np.nansum([q.iou * q.wanted for q in found]) / max(wanted, 1)),
    )


def _folds(views: Sequence[View]) -> npt.NDArray[np.intp]:
    """Fold of each view; views of one scene share it."""
    names = list(dict.fromkeys(view.scene for view in views))
    return np.array([names.index(view.scene) % FOLDS for view in views])


def _fitted(
    pairs: Sequence[Examples], seen: Sequence[Seen], config: SegmentConfig
) -> tuple[Logistic, Logistic]:
    """The models of pairs and of parts."""
    parts = []
    for k in range(FOLDS):
        others = [p for p, s in zip(pairs, seen, strict=True) if s.fold != k] or list(pairs)
        model = _fit(others, PAIR_FEATURES)
        parts += [_parts(s, config, model) for s in seen if s.fold == k]
    return _fit(pairs, PAIR_FEATURES), _fit(parts, PART_FEATURES)


def _pixels(view: View, config: SegmentConfig, rng: np.random.Generator) -> tuple[F32, Mask]:
    """Features (N, F) and truths (N,) of some of a view's pixels that may be ore; more of a view
    that weighs more.

    Half of them are ore, as many of each lump: a small one must not be lost for the sake of a large
    one's outline.
    """
    sight = measure_view(view.surface, view.grizzly, config, bounded=view.volume is not None).sight
    at, count = rng.permutation(candidates(sight)), int(PIXELS * view.weight)
    lump = _cropped(view).ravel()[at]
    lumps = [at[lump == number] for number in np.unique(lump[lump >= FIRST_LUMP])]
    others = at[lump < FIRST_LUMP][: count // 2 if lumps else count]
    chosen = np.sort(
        np.concatenate([others, *(of_one[: count // 2 // len(lumps)] for of_one in lumps)])
    )
    return pixel_features(sight, chosen), _cropped(view).ravel()[chosen] >= FIRST_LUMP


def _network(pixels: Sequence[tuple[F32, Mask]]) -> Network:
    features, truth = (np.concatenate(column) for column in zip(*pixels, strict=True))
    return fit_network(features, truth, HIDDEN, EPOCHS, seed=0)


def _fit(examples: Sequence[Examples], names: tuple[str, ...]) -> Logistic:
    from sklearn.linear_model import LogisticRegression

    features = np.concatenate([e.features for e in examples])
    weight = np.concatenate([e.weight for e in examples])
    mean, spread = features.mean(0), features.std(0) + 1e-9
    model = LogisticRegression(max_iter=1000)
    truth = np.concatenate([e.truth for e in examples])
    model.fit((features - mean) / spread, truth, sample_weight=weight / weight.mean())
    rows = [_rounded(row) for row in (mean, spread, model.coef_[0], model.intercept_)]
    return Logistic(names, rows[0], rows[1], rows[2], rows[3][0])


def _rounded(values: F64) -> tuple[float, ...]:
    """Four significant figures: readable, and more than the decision needs."""
    return tuple(float(f"{value:.4g}") for value in values)


def _pairs_of(seen: Seen, config: SegmentConfig, rng: np.random.Generator) -> Examples:
    """Neighbouring parts, first as cut, then as more and more of those of one lump are joined in
    random order.
    """
    features, truths = [], []
    for heap in _heaps(seen, config):
        owner, purity = _owners(heap.labels, heap.instance)
        parts = measure(heap.scene, heap.labels)
        while len(parts.pairs):
            a, b = parts.pairs.T
            same = (owner[a] == owner[b]) & (owner[a] >= FIRST_LUMP)
            use = (purity[parts.pairs].min(1) > PURE) & (owner[parts.pairs].max(1) >= FIRST_LUMP)
            features.append(pair_features(heap.scene, parts)[use])
            truths.append(same[use])
            if not same.any():
                break
            into = np.arange(len(parts.name), dtype=np.int32)
            chosen = rng.permutation(np.flatnonzero(same))
            for one, other in parts.pairs[chosen[: max(1, len(chosen) // 2)]].tolist():
                into[into == into[other]] = into[one]
            parts = join(parts, into)
    return Examples.of(features, truths, len(PAIR_FEATURES), seen.view.weight)


def _parts(seen: Seen, config: SegmentConfig, pair: Logistic) -> Examples:
    """Merged parts that are large enough to be lumps."""
    features, truths = [], []
    for heap in _heaps(seen, config):
        labels = filled(merge_parts(heap.scene, heap.labels, config.merge_probability, pair))
        owner, _ = _owners(labels, heap.instance)
        large = np.flatnonzero(
            np.bincount(labels.ravel()) > (config.min_size_m / heap.pixel_m) ** 2
        )
        large = large[large > 0]
        features.append(part_features(heap.scene, labels)[large])
        truths.append(owner[large] >= FIRST_LUMP)
    return Examples.of(features, truths, len(PART_FEATURES), seen.view.weight)


@dataclass(frozen=True)
class _Heap:
    scene: segment.Scene
    labels: I32
    instance: I32
    pixel_m: float


def _heaps(seen: Seen, config: SegmentConfig) -> Iterator[_Heap]:
    """The heaps of a view as cut into parts, and the truth at their size."""
    view, instance = seen.view, _cropped(seen.view)
    looked = segment.look(
        view.surface, view.grizzly, config, seen.network, bounded=view.volume is not None
    )
    for box, coarse in segment.coarse_heaps(looked, config):
        scene, labels = segment.oversegment(coarse, config)
        if labels.any():
            small = cv2.resize(instance[box], labels.shape[::-1], interpolation=cv2.INTER_NEAREST)
            yield _Heap(scene, labels, small.astype(np.int32), coarse.relief.pixel_m)


def _cropped(view: View) -> U8:
    """The true labels of the surface's crop."""
    row, column = view.surface.y0, view.surface.x0
    height, width = view.surface.xyz.shape[:2]
    return view.instance[row : row + height, column : column + width].astype(np.uint8)


def _owners(labels: I32, instance: I32) -> tuple[npt.NDArray[np.intp], F64]:
    """The true label that most of each part 0…n has, and its share of the part."""
    shape = (int(labels.max(initial=0)) + 1, int(instance.max(initial=0)) + 1)
    common = np.bincount(
        labels.ravel().astype(np.int64) * shape[1] + instance.ravel(), minlength=shape[0] * shape[1]
    )
    common = common.reshape(shape)
    return common.argmax(1), common.max(1) / np.maximum(common.sum(1), 1)
