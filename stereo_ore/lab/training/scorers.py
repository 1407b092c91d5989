"""Training of the adaptive filter's scorers on labelled clouds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.lab.bench.labelled import LabelledCloud
from stereo_ore.lab.training.networks import fit_network
from stereo_ore.network import Network, average
from stereo_ore.stages import filters
from stereo_ore.stages.filters.adaptive import evidence_of, judge_pass
from stereo_ore.stages.filters.evidence import WHOLE_FEATURES, Evidence, Rows
from stereo_ore.stages.filters.scorer import Scorer
from stereo_ore.threads import map_rows
from stereo_ore.types import F32, Mask


@dataclass(frozen=True)
class Fit:
    """A network to be fitted: its hidden units, and how many of the last features it does
    without.
    """

    hidden: int
    without: int = 0


@dataclass(frozen=True)
class Recipe:
    """How a scorer is fitted: for each pass the networks that it is the mean of
    (`network.average`).

    Each cloud gives `sample` points to learn from, and of its noise at least `noise` points where
    it has them: where one point of a hundred is noise, a sample would hardly show it. `threshold`
    and `most_lost` are the scorer's.
    """

    passes: tuple[tuple[Fit, ...], ...]
    sample: int
    epochs: int
    threshold: float
    most_lost: float | None = None
    noise: int = 0


RECIPES = {
    # The network that does without the whole cloud knows clumps beside a smooth surface better,
    # that with it all else.
    "geometry": Recipe(3 * ((Fit(32), Fit(32, len(WHOLE_FEATURES))),), 1500, 10, 0.5, noise=100),
    # Two fits of one recipe differ by 0.03 of F1 on sets not seen; several hardly do.
    "stereo": Recipe((3 * (Fit(32),), 4 * (Fit(40),)), 6000, 12, 0.2, 0.065),
}


@dataclass(frozen=True)
class Lesson:
    """Evidence of a cloud, the truth (M,), the rows that can be judged, and those of them to learn
    from.
    """

    name: str
    cell: str
    evidence: Evidence
    is_noise: Mask
    judged: Rows
    chosen: Rows


def lessons(clouds: Iterable[LabelledCloud], kind: str, seed: int = 0) -> list[Lesson]:
    """What there is to learn from clouds, all with cues or all without; `seed` is that of the
    sample.
    """
    rng = np.random.default_rng(seed)
    return [_lesson(labelled, RECIPES[kind], rng) for labelled in clouds]


def train_scorer(clouds: Iterable[LabelledCloud], kind: str, seed: int = 0) -> Scorer:
    """Fit a scorer of a `kind` of `RECIPES` to clouds; `seed` is that of sample and networks."""
    return fit(lessons(clouds, kind, seed), kind, seed)


def fit(learned: Sequence[Lesson], kind: str, seed: int = 0) -> Scorer:
    """Fit the networks of successive passes, each to what the passes before it left."""
    recipe = RECIPES[kind]
    noise = [lesson.evidence.prior for lesson in learned]
    passes: list[Network] = []
    for number, fits in enumerate(recipe.passes):
        tables, truths = zip(
            *(_examples(*each, number) for each in zip(learned, noise, strict=True)), strict=True
        )
        truth = np.concatenate(truths)
        if len(np.unique(truth)) < 2:
            # The passes before it left nothing to be learned.
            break
        passes.append(_fit(np.concatenate(tables), truth, fits, recipe.epochs, seed))
        if number + 1 < len(recipe.passes):
            noise = [
                judge_pass(x.evidence, p, passes[-1], number)
                for x, p in zip(learned, noise, strict=True)
            ]
    return Scorer(list(learned[0].evidence.names), passes, recipe.threshold, recipe.most_lost)


def _lesson(labelled: LabelledCloud, recipe: Recipe, rng: np.random.Generator) -> Lesson:
    voxels, rows = filters.prepared(labelled.voxels)
    judged = (
        np.arange(len(rows)) if labelled.judged is None else np.flatnonzero(labelled.judged[rows])
    )
    order, is_noise = rng.permutation(judged), labelled.is_noise[rows]
    chosen = np.union1d(order[: recipe.sample], order[is_noise[order]][: recipe.noise])
    evidence = evidence_of(voxels, AdaptiveParams().k)[1]
    return Lesson(labelled.name, labelled.cell, evidence, is_noise, judged, chosen)


def _examples(lesson: Lesson, noise: F32, number: int) -> tuple[F32, Mask]:
    """Features and truth of those chosen points that pass `number` is asked about."""
    asked = lesson.evidence.ask(noise, number)
    sample = np.flatnonzero(np.isin(asked.rows, lesson.chosen))
    table = map_rows(asked.table, len(asked.rows))[sample]
    whole = np.broadcast_to(asked.whole, (len(sample), len(asked.whole)))
    return np.hstack([table, whole]), lesson.is_noise[asked.rows[sample]]


def _fit(examples: F32, truth: Mask, fits: tuple[Fit, ...], epochs: int, seed: int) -> Network:
    width = examples.shape[1]
    return average([
        fit_network(examples, truth, fit.hidden, epochs, seed + number, width - fit.without)
        for number, fit in enumerate(fits)
    ])  # fmt: skip
