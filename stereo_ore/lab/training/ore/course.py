"""From nothing to a model folder: examples are made, a network is trained, judged and written.

All is kept in the output folder as it comes, and a command that is given again goes on from there.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stereo_ore.config import SegmentConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab.training.ore import examples, judge
from stereo_ore.lab.training.ore.crops import Seen
from stereo_ore.stages.segment import model as models
from stereo_ore.stages.segment.whole import FEATURES, Whole
from stereo_ore.version import __version__

_log = logging.getLogger(__name__)

_RANGES = 12
"""Examples of each kind that the ranges of the network's values are taken from."""
_HELD = 8
"""Every so manyth seed is not trained on, but judges."""
SHARES = (0.4, 0.6)
"""Of crops from scene folders, and from drawn screens."""


@dataclass(frozen=True)
class Course:
    """What to train on: seeds of drawn screens, scene folders with truth; for how long; and the
    model to go on from, if any.
    """

    out: Path
    seeds: range
    folders: tuple[Path, ...]
    minutes: float
    start: models.LumpModel | None = None

    @property
    def cache(self) -> Path:
        """Where examples are kept."""
        return self.out / "examples"


def needs() -> None:
    """Say what is missing of the extra ``train``.

    Raises
    ------
    ConfigError
        Naming the package.
    """
    for package in ("torch", "mujoco", "onnxscript"):
        if find_spec(package) is None:
            raise ConfigError(
                f"{package} is not installed",
                key="--train",
                remedy='Install it: pip install "stereo-ore[train]"',
            )


def _make(course: Course) -> None:
    """Write the examples that are not there yet: those of folders, then those of seeds."""
    course.cache.mkdir(parents=True, exist_ok=True)
    for folder in course.folders:
        path = course.cache / f"scene-{folder.name}.npz"
        if not path.exists() and (found := examples.of_folder(folder)) is not None:
            examples.save_example(found, path)
    for seed in course.seeds:
        done = course.cache / f"seed-{seed}.done"
        if done.exists():
            continue
        count = 0
        for number, example in enumerate(examples.of_seed(seed)):
            examples.save_example(example, course.cache / f"seed-{seed}-{number}.npz")
            count += 1
        done.touch()
        _log.info("seed %d: %d examples", seed, count)


def train_ore(course: Course) -> Path:
    """Make examples, train the network, judge it on seeds held out, write the model folder."""
    needs()
    _make(course)
    folders = [course.cache / f"scene-{f.name}.npz" for f in course.folders]
    seeds = [s for s in course.seeds if s % _HELD]
    groups = [_seen(folders), _seen(_views(course, seeds))]
    if not any(groups):
        raise ConfigError("there is nothing to train on", key="--seeds", remedy="Give more seeds")
    from stereo_ore.lab.training.ore import fit, net

    shares = [share for share, group in zip(SHARES, groups, strict=True) if group]
    present = [group for group in groups if group]
    checkpoint = course.out / "checkpoint.pt"
    start = course.start.onnx if course.start else None
    network = fit.train(lambda: present, shares, course.minutes, checkpoint, start, say=_log.info)
    held = _views(course, [s for s in course.seeds if not s % _HELD])
    onnx = course.out / "model.onnx.part"
    net.export(network, onnx, [each.example.x for each in _spread(present)])
    about = {"made by": _origin(course), **_known(course), **_judged(network, held)}
    models.write(course.out / "model", onnx.read_bytes(), about)
    onnx.unlink()
    return course.out / "model"


def _spread(groups: Sequence[Sequence[Seen]]) -> list[Seen]:
    """At most `_RANGES` of each group, evenly chosen."""
    return [each for group in groups for each in group[:: -(-len(group) // _RANGES)]]


def _judged(network: Any, held: Sequence[Path]) -> dict[str, Any]:
    """The model of whole lumps, and the quality on examples held out, half for each."""
    from stereo_ore.lab.training.ore import net

    config = SegmentConfig()
    seen = [examples.load_example(path) for path in held]
    rows = [judge.named(lambda x: net.outputs_of(network, x), e, config) for e in seen]
    half = len(rows) // 2
    if len({flag for row in rows[:half] for flag in row.good}) < 2:
        return {}
    entry = judge.fit_whole(rows[:half])
    left = list(zip(seen, rows, strict=True))[half:]
    quality = judge.ore_quality(left, Whole.read(entry), config.lump_probability)
    _log.info("on screens never seen: %s", quality)
    return {"whole": entry, "quality on drawn screens left out": quality}


def _known(course: Course) -> dict[str, Any]:
    """The model of whole lumps to go on from, for when too little is left out to fit one."""
    whole = course.start.whole if course.start else None
    return {"whole": {"features": FEATURES, **asdict(whole)}} if whole else {}


def _origin(course: Course) -> dict[str, Any]:
    return {
        "version": __version__,
        "seeds": [course.seeds.start, course.seeds.stop - 1],
        "seeds held out": f"every {_HELD}th",
        "scenes": sorted(folder.name for folder in course.folders),
        "minutes": course.minutes,
        "started from": course.start.card.sha256 if course.start else None,
    }


def _views(course: Course, seeds: Sequence[int]) -> list[Path]:
    return [path for s in seeds for path in sorted(course.cache.glob(f"seed-{s}-*.npz"))]


def _seen(paths: Sequence[Path]) -> list[Seen]:
    return [Seen(examples.load_example(path)) for path in paths if path.exists()]
