"""Where a scorer comes from, and how good it is on what it did not learn from: written into its
file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.lab.bench.clean import clean_clouds
from stereo_ore.lab.bench.labelled import LabelledCloud, bare_cloud, paper_clouds
from stereo_ore.lab.metrics import filter_quality
from stereo_ore.lab.synth.outliers import plant_outliers
from stereo_ore.lab.training import scorers
from stereo_ore.stages import filters
from stereo_ore.stages.filters.adaptive import evidence_of, run_passes
from stereo_ore.stages.filters.scorer import Scorer
from stereo_ore.types import Mask
from stereo_ore.version import __version__

LEFT_OUT = ("haze", "ghost")
"""Kinds of outliers that no training has."""

_FOLDS = 6
"""Fits that judge a stereo scorer; so many real sets are left out one by one."""


def of_geometry(scorer: Scorer, seeds: range, scans: Sequence[str]) -> Scorer:
    """A scorer with its origin: shapes, kinds and seeds left out judge it."""
    clean = [100 * float(_removed(scorer, c).mean()) for c in clean_clouds(range(1), [])]
    protocol = [_f1(scorer, c) for c in paper_clouds(range(1))]
    other = [_f1(scorer, c) for c in _strange()]
    left_out = {
        "clean shapes, share removed, worst [%]": round(max(clean), 2),
        "clean shapes, share removed, median [%]": round(float(np.median(clean)), 2),
        "paper's protocol, seed 0, F1": round(float(np.mean(protocol)), 3),
        f"{' and '.join(LEFT_OUT)}, F1": round(float(np.mean(other)), 3),
    }
    fitted = {"seeds": [seeds.start, seeds.stop - 1], "scans": sorted(scans)}
    return replace(scorer, provenance=_origin(fitted, left_out))


def of_stereo(scorer: Scorer, learned: Sequence[scorers.Lesson]) -> Scorer:
    """A scorer with its origin: fits to other sets judge it on each real set as it is."""
    cells = sorted({lesson.cell for lesson in learned if lesson.name != lesson.cell})
    figures: dict[str, Any] = {}
    for fold in range(min(_FOLDS, len(cells)) if len(cells) > 1 else 0):
        out = set(cells[fold::_FOLDS])
        other = scorers.fit([lesson for lesson in learned if lesson.cell not in out], "stereo")
        figures |= {lesson.name: _judged(other, lesson) for lesson in learned if lesson.cell in out}
    fitted = {
        "clouds": len(learned),
        "kinds": dict(sorted(Counter(lesson.cell for lesson in learned).items())),
    }
    return replace(scorer, provenance=_origin(fitted, figures))


def _origin(fitted: dict[str, Any], left_out: dict[str, Any]) -> dict[str, Any]:
    return {"version": __version__, "seed": 0, "fitted to": fitted, "left out": left_out}


def _removed(scorer: Scorer, labelled: LabelledCloud) -> Mask:
    voxels, _ = filters.prepared(labelled.voxels)
    noise = run_passes(evidence_of(voxels, AdaptiveParams().k)[1], scorer)
    return np.asarray(noise > scorer.decide(noise))


def _f1(scorer: Scorer, labelled: LabelledCloud) -> float:
    _, rows = filters.prepared(labelled.voxels)
    return filter_quality(labelled.is_noise[rows], _removed(scorer, labelled)).f1


def _judged(scorer: Scorer, lesson: scorers.Lesson) -> dict[str, float]:
    """Shares of noise, F1 and good points kept of a lesson's cloud."""
    noise = run_passes(lesson.evidence, scorer)
    truth = lesson.is_noise[lesson.judged]
    quality = filter_quality(truth, (noise > scorer.decide(noise))[lesson.judged])
    figures = {
        "noise": float(truth.mean()),
        "F1": quality.f1,
        "good points kept": quality.retention,
    }
    return {name: round(value, 3) for name, value in figures.items()}


def _strange() -> Iterable[LabelledCloud]:
    """Outliers of kinds left out, on shapes left out."""
    for number, labelled in enumerate(clean_clouds(range(1), [])):
        for kind in LEFT_OUT:
            xyz, noise = plant_outliers(
                np.random.default_rng(number), labelled.voxels.xyz.astype(float), 0.05, kind
            )
            yield LabelledCloud(f"{labelled.name}, {kind}", kind, bare_cloud(xyz), noise)
