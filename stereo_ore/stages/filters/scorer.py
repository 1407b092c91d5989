"""The networks that tell noise from a point's features, shipped as readable JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import ConfigError
from stereo_ore.network import Network
from stereo_ore.types import F32


@dataclass(frozen=True)
class Scorer:
    """The networks of successive passes, and the names of all features; a network may take only the
    first of them.

    A point is noise above `threshold` unless parameters say otherwise. With `most_lost`, it is
    noise above that probability, not less than `threshold`, with the greatest F1 foretold, where no
    more than this share of the good points is foretold to go. `provenance` says what the networks
    were fitted to, by which version and seed, and how good they were on clouds left out.
    """

    features: list[str]
    passes: list[Network]
    threshold: float = 0.5
    most_lost: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def decide(self, noise: F32) -> float:
        """Probability above which points with noise probabilities (M,) are removed.

        The n points of the highest probabilities p hold Σp of noise and Σ(1 − p) of good points, as
        far as the probabilities are right.
        """
        falling = np.sort(noise)[::-1].astype(np.float64)
        falling = falling[: int(np.searchsorted(-falling, -self.threshold))]
        if self.most_lost is None or not len(falling):
            return self.threshold
        found, lost = np.cumsum(falling), np.cumsum(1 - falling)
        f1 = 2 * found / (np.arange(1, len(falling) + 1) + noise.sum(dtype=np.float64))
        bearable = lost <= self.most_lost * (1 - noise.astype(np.float64)).sum()
        best = int(np.argmax(np.where(bearable, f1, 0)))
        return float(falling[best + 1]) if best + 1 < len(falling) else self.threshold

    def to_json(self) -> str:
        """Readable text, a row of weights a line."""
        text = json.dumps(asdict(self), ensure_ascii=False, indent=1)
        return text.replace(",\n    ", ", ").replace("[\n    ", "[").replace("\n   ]", "]") + "\n"

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scorer:
        """The scorer that `to_json` wrote."""
        return cls(**{**data, "passes": [Network(**network) for network in data["passes"]]})


@cache
def load_scorer(name: str) -> Scorer:
    """A scorer that ships with the package: ``geometry`` or ``stereo``."""
    text = (files("stereo_ore.stages.filters") / "scorers" / f"{name}.json").read_text(
        encoding="utf-8"
    )
    return Scorer.from_dict(json.loads(text))


@cache
def read(path: Path) -> Scorer:
    """A scorer that `tune --train` wrote.

    Raises
    ------
    ConfigError
        When the file can't be read, or is none.
    """
    try:
        return Scorer.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as fault:
        raise ConfigError(
            f"can't be read: {fault.strerror}", file=path, key="filter.params.scorer"
        ) from None
    except (ValueError, TypeError, KeyError):
        remedy = "Name a file that tune --train geometry or stereo wrote"
        raise ConfigError(
            "is no scorer", file=path, key="filter.params.scorer", remedy=remedy
        ) from None
