"""``stereo-ore tune``: find a filter's parameters on clouds whose noise is known, or train its
scorer.
"""

from __future__ import annotations

import itertools
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from stereo_ore.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress

_log = logging.getLogger(__name__)
Item = TypeVar("Item")


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(tune)


def tune(
    out: Annotated[
        Path, typer.Argument(help="Folder for config.yaml and cost.png, or for the trained scorer.")
    ],
    method: Annotated[
        str, typer.Option(help="paper, adaptive, statistical, radius or lof.")
    ] = "paper",
    cloud: Annotated[
        list[Path] | None,
        typer.Option(help="Labelled cloud [m] with a column noise; else synthetic ones."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=0, max=500, help="Seeds of synthetic clouds, from 100 on.")
    ] = 2,
    cost: Annotated[
        Path | None, typer.Option(help="YAML: weights of precision, recall and retention.")
    ] = None,
    train: Annotated[
        str | None,
        typer.Option(
            help=(
                "geometry or stereo: train adaptive's scorer instead; ore: the network of lumps; "
                "solids: the prior; confidence: that of disparities, on the pairs of --scene."
            )
        ),
    ] = None,
    scene: Annotated[
        list[Path] | None, typer.Option(help="Scene folder with truth to train on as well.")
    ] = None,
    scan: Annotated[
        list[Path] | None, typer.Option(help="geometry: a scan without outliers, to learn from.")
    ] = None,
    sets: Annotated[
        Path | None, typer.Option(help="stereo: folder of real pairs with true disparities.")
    ] = None,
    minutes: Annotated[
        float, typer.Option(min=0.01, help="ore: how long the network is trained.")
    ] = 60.0,
    start: Annotated[
        str | None,
        typer.Option(help="ore: go on from this model, a folder or 'shipped', not from nothing."),
    ] = None,
) -> None:
    """Find the parameters with the least cost, the weighted mean of 1 − P_r, 1 − Recall and 1 −
    Retain.

    Synthetic clouds for tuning have seeds from 100 on; `bench filter` reports on seeds below that.

    Example: `stereo-ore tune tuned --method paper` then `stereo-ore run … --config
    tuned/config.yaml`
    """
    if train:
        material = _Material(seeds, tuple(scene or ()), tuple(scan or ()), sets, minutes, start)
        _train(out, train, material)
    else:
        _search(out, method, cloud or [], seeds, cost)


def _search(out: Path, method: str, files: list[Path], seeds: int, cost: Path | None) -> None:
    import yaml

    from stereo_ore.config.validation import validate
    from stereo_ore.draw.figures import if_possible
    from stereo_ore.io.atomic import make_folder
    from stereo_ore.io.yaml_io import load_yaml
    from stereo_ore.lab import tune as tuning
    from stereo_ore.lab.bench import labelled

    weights = validate(
        tuning.CostWeights,
        load_yaml(cost, ConfigError) if cost else {},
        cost or "cost",
        ConfigError,
    )
    start = labelled.TUNING_SEED
    made = [] if files else labelled.paper_clouds(range(start, start + seeds))
    clouds = [*map(labelled.labelled_file, files), *made]
    make_folder(out)
    with _progress() as progress:
        task = progress.add_task(f"tune {method}", total=None)
        tuned = tuning.search_parameters(method, clouds, weights, lambda: progress.advance(task))
    text = yaml.safe_dump(tuned.config(), sort_keys=False)
    (out / "config.yaml").write_text(text, encoding="utf-8")
    if_possible(lambda: tuning.plot(tuned, out / "cost.png"))
    _log.info("cost %.4f on %d clouds; %s", tuned.cost, len(clouds), out / "config.yaml")
    typer.echo(text, nl=False)


@dataclass(frozen=True)
class _Material:
    """What there is to learn from: seeds of made things, scene folders, clean scans, a folder of
    real pairs; for how long, and from which model on.
    """

    seeds: int
    scenes: tuple[Path, ...] = ()
    scans: tuple[Path, ...] = ()
    sets: Path | None = None
    minutes: float = 60.0
    start: str | None = None


def _train(out: Path, kind: str, material: _Material) -> None:
    from stereo_ore.io.atomic import make_folder
    from stereo_ore.lab.bench.labelled import TUNING_SEED

    trainers = {
        "geometry": _train_geometry,
        "stereo": _train_stereo,
        "solids": _train_solids,
        "confidence": _train_confidence,
    }
    if kind not in (*trainers, "ore"):
        raise ConfigError(
            f"{kind!r} can't be trained",
            key="--train",
            remedy=f"Use one of {', '.join((*trainers, 'ore'))}",
        )
    make_folder(out)
    seeds = range(TUNING_SEED, TUNING_SEED + material.seeds)
    if kind == "ore":
        typer.echo(_train_ore(seeds, material, out))
        return
    text = trainers[kind](seeds, material)
    path = out / f"{kind}.json"
    path.write_text(text, encoding="utf-8")
    typer.echo(path)


def _train_geometry(seeds: range, material: _Material) -> str:
    """JSON of the scorer of clouds without cues, with its quality on clouds and kinds left out."""
    from stereo_ore.lab.bench.clean import scan
    from stereo_ore.lab.training import bare_clouds, provenance, scorers

    scans = [scan(path) for path in material.scans]
    made = bare_clouds.bare_clouds(seeds, scans)
    scorer = scorers.train_scorer(
        _watched(made, bare_clouds.clouds_a_seed() * len(seeds), "clouds"), "geometry"
    )
    return provenance.of_geometry(scorer, seeds, [path.name for path in material.scans]).to_json()


def _train_stereo(seeds: range, material: _Material) -> str:
    """JSON of the scorer of stereo clouds, with its quality on real sets left out."""
    from stereo_ore.lab.bench.stereo_sets import find_sets
    from stereo_ore.lab.training import provenance, scorers, stereo_clouds

    sets = list(find_sets(material.sets)) if material.sets else []
    made = stereo_clouds.stereo_clouds(sets, material.scenes, seeds)
    clouds = _watched(made, stereo_clouds.count_scenes(sets, material.scenes, seeds), "clouds")
    lessons = scorers.lessons(clouds, "stereo")
    scorer = scorers.fit(lessons, "stereo")
    return provenance.of_stereo(scorer, lessons).to_json()


def _train_ore(seeds: range, material: _Material, out: Path) -> Path:
    """Folder of the network of lumps; its quality on screens left out is logged and in its card."""
    from stereo_ore.lab.training.ore import course
    from stereo_ore.stages.segment import load_lump_model

    start = load_lump_model(material.start) if material.start else None
    return course.train_ore(course.Course(out, seeds, material.scenes, material.minutes, start))


def _train_solids(seeds: range, material: _Material) -> str:
    """JSON of the solids' shape prior; its errors on scenes left out of the fit are logged."""
    from stereo_ore.lab.training import casts, shape_prior, solids

    found = [sample for folder in material.scenes for sample in solids.recorded(folder)]
    made = map(casts.made_up, range(casts.FIRST_SEED, casts.FIRST_SEED + len(seeds)))
    found += itertools.chain.from_iterable(_watched(made, len(seeds), "screens"))
    if not found:
        raise ConfigError("no lump was found", key="--seeds", remedy="Give more seeds or scenes")
    prior, errors = shape_prior.train_prior(found)
    for name, recorded in ("scene folders", True), ("made-up screens", False):
        rows = [
            i for i, s in enumerate(found) if s.seen_as == "measured" and s.recorded is recorded
        ]
        if rows:
            quality = shape_prior.prior_quality([found[i] for i in rows], errors[rows])
            _log.info("%s left out: %s", name, quality)
    return prior.to_json()


def _train_confidence(_seeds: range, material: _Material) -> str:
    """JSON of the confidence's network; its quality on sets left out is logged."""
    from stereo_ore.config import MatchingConfig
    from stereo_ore.lab.bench import stereo_sets
    from stereo_ore.lab.training import confidence

    folders = (*material.scenes, *((material.sets,) if material.sets else ()))
    if not folders:
        raise ConfigError(
            "no set was given", key="--scene", remedy="Give folders of stereo pairs with truth"
        )
    sets = (data for folder in folders for data in stereo_sets.find_sets(folder))
    examples = list(confidence.training_views(sets, MatchingConfig()))
    network, quality = confidence.train_confidence(examples)
    for each in quality:
        _log.info("%s left out: area under ROC %s", each.set, each.auc and round(each.auc, 3))
    return confidence.to_json(network, quality, examples, seed=0)


def _watched(items: Iterator[Item], total: int, what: str) -> Iterator[Item]:
    with _progress() as progress:
        yield from progress.track(items, total=total, description=what)


def _progress() -> Progress:
    from rich.console import Console
    from rich.progress import Progress

    shown = sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    return Progress(console=Console(stderr=True), disable=not shown)
