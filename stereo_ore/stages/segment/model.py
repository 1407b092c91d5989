"""The network of lumps as a folder: `model.onnx`, and `card.json` that says what it is."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore import engine
from stereo_ore.errors import ConfigError
from stereo_ore.stages.segment.channels import CHANNELS, STRIDE, UNIT
from stereo_ore.stages.segment.outputs import OUTPUTS
from stereo_ore.stages.segment.whole import Whole
from stereo_ore.types import F32

_FORMAT, _VERSION = "stereo_ore/lump-model", 1
_SHIPPED = "shipped"
"""Name of the model that comes with the package."""
KEY = "models.lumps"
_REMEDY = (
    "Make it with: stereo-ore tune OUT --train ore; or leave the key out for the shipped model"
)


@dataclass(frozen=True)
class Card:
    """What a model is: inputs, scale, outputs, hash of the network, the model of whole lumps; and
    the rest as it was written: how it was trained and how good it is.
    """

    inputs: tuple[str, ...]
    unit_px: int
    outputs: tuple[str, ...]
    sha256: str
    whole: Whole | None
    about: dict[str, Any]


class LumpModel:
    """A network that is ready to run, in any number of threads at once; copies that other processes
    get load it again.

    Parameters
    ----------
    onnx : bytes
        The network.
    card : Card
        What it says of itself.
    """

    def __init__(self, onnx: bytes, card: Card) -> None:
        self.onnx, self.card = onnx, card

    @property
    def whole(self) -> Whole | None:
        """The model of whole lumps, where the card has one."""
        return self.card.whole

    def __getstate__(self) -> dict[str, Any]:
        return {"onnx": self.onnx, "card": self.card}

    def __call__(self, x: F32) -> F32:
        """Outputs (5, h, w) of channels (C, h, w), as `outputs.OUTPUTS`, not yet rounded."""
        h, w = x.shape[1:]
        if h % STRIDE or w % STRIDE:
            x = np.pad(x, [(0, 0), (0, -h % STRIDE), (0, -w % STRIDE)])
        (found,) = self._session.run(None, {self._session.get_inputs()[0].name: x[None]})
        return np.asarray(found[0, :, :h, :w], np.float32)

    def check(self) -> None:
        """Refuse what is no network, or one of other inputs, outputs or of fixed sides.

        Raises
        ------
        ConfigError
            Naming what is wrong, and the remedy.
        """
        sides = [
            [side if isinstance(side, int) else None for side in end.shape]
            for ends in (self._session.get_inputs(), self._session.get_outputs())
            for end in ends
        ]
        wanted = [[1, len(names), None, None] for names in (CHANNELS, OUTPUTS)]
        if sides != wanted:
            raise ConfigError(
                f"model.onnx has inputs and outputs of {sides}: {wanted} are needed, where None is"
                " any length",
                key=KEY,
                remedy=_REMEDY,
            )

    @cached_property
    def _session(self) -> Any:
        """The network in ONNX Runtime, with the threads that OpenCV is given."""
        try:
            return engine.session(self.onnx, max(cv2.getNumThreads(), 1))
        except Exception as error:  # of a dozen kinds, which have no other base
            raise ConfigError(
                "model.onnx is no network that ONNX Runtime can read", key=KEY, remedy=_REMEDY
            ) from error


def load_lump_model(place: str = _SHIPPED) -> LumpModel:
    """The model of a folder, or the one that ships with the package.

    Raises
    ------
    ConfigError
        Naming file, key, value and remedy, when it is none or wants other inputs than are made.
    """
    return _shipped() if place == _SHIPPED else _read(Path(place))


@cache
def _shipped() -> LumpModel:
    return _read(Path(str(files("stereo_ore") / "models" / "lumps")))


def _read(folder: Path) -> LumpModel:
    network, card = folder / "model.onnx", folder / "card.json"
    try:
        onnx, text = network.read_bytes(), card.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{str(folder)!r} holds no model: {error.strerror} ({Path(error.filename).name})",
            key=KEY,
            remedy=_REMEDY,
        ) from error
    model = LumpModel(onnx, _checked(card, text, onnx))
    model.check()
    return model


def _checked(path: Path, text: str, onnx: bytes) -> Card:
    """The card, once it fits this program and its network."""
    try:
        data = json.loads(text)
        card = Card(
            tuple(data["inputs"]),
            int(data["unit_px"]),
            tuple(data["outputs"]),
            str(data["sha256"]),
            Whole.read(data["whole"]) if data.get("whole") else None,
            {key: value for key, value in data.items() if key not in Card.__dataclass_fields__},
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"no card of a model: {error!r}", file=path, remedy=_REMEDY) from error
    expected: dict[str, tuple[Any, Any]] = {
        "format": (data.get("format"), _FORMAT),
        "version": (data.get("version"), _VERSION),
        "inputs": (card.inputs, CHANNELS),
        "unit_px": (card.unit_px, UNIT),
        "outputs": (card.outputs, OUTPUTS),
        "sha256": (card.sha256, hashlib.sha256(onnx).hexdigest()),
    }
    for key, (given, wanted) in expected.items():
        if given != wanted:
            raise ConfigError(
                f"{given!r} does not fit: {wanted!r} is needed", file=path, key=key, remedy=_REMEDY
            )
    return card


def write(folder: Path, onnx: bytes, about: dict[str, Any]) -> None:
    """Write a model folder; `about` goes into its card."""
    folder.mkdir(parents=True, exist_ok=True)
    card = {
        "format": _FORMAT,
        "version": _VERSION,
        "inputs": CHANNELS,
        "unit_px": UNIT,
        "outputs": OUTPUTS,
        "sha256": hashlib.sha256(onnx).hexdigest(),
        **about,
    }
    (folder / "model.onnx").write_bytes(onnx)
    (folder / "card.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
