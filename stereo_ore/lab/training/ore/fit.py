"""The training itself: AdamW under a cosine, averaged weights, a checkpoint every few minutes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stereo_ore.lab.training.ore.crops import Seen, training_crop
from stereo_ore.lab.training.ore.net import LumpNet, loss_of, restored

BATCH = 12
RATE, RATE_ON, DECAY, CLIP, WARM_UP = 3e-3, 1.2e-3, 1e-4, 2.0, 50
"""Highest learning rate from nothing and from a model, weight decay, largest gradient, steps until
the highest rate."""
_FIRST = 25
"""Batches that the statistics of a model to go on from are measured on."""
KEEP = 0.998
"""Share of the averaged weights that a step leaves."""
SAVE_S = 120.0
"""Seconds between checkpoints."""


@dataclass
class _Course:
    """How far a training is: its network, optimiser and averaged weights."""

    net: LumpNet
    optimiser: Any
    average: dict[str, Any]
    highest: float
    step: int = 0
    seconds: float = 0.0

    def rate(self, minutes: float) -> float:
        """Learning rate now."""
        done = min(self.seconds / (60 * minutes), 1.0)
        cosine = 0.5 + 0.5 * float(np.cos(np.pi * done))
        return self.highest * min(1, (self.step + 1) / WARM_UP) * cosine + 1e-5


class _Drawn:
    """Examples drawn at random: groups by their shares, in them crowded screens more often."""

    def __init__(self, groups: Sequence[Sequence[Seen]], shares: Sequence[float]) -> None:
        self._all = [seen for group in groups for seen in group]
        each = []
        for group, share in zip(groups, shares, strict=True):
            crowded = np.sqrt([1.0 + len(seen.aims[1]) for seen in group])
            each.append(share * crowded / crowded.sum())
        self._share = np.concatenate(each) / sum(shares)

    def __call__(self, rng: np.random.Generator) -> Seen:
        return self._all[int(rng.choice(len(self._all), p=self._share))]

    def __len__(self) -> int:
        return len(self._all)


def train(
    groups: Callable[[], Sequence[Sequence[Seen]]],
    shares: Sequence[float],
    minutes: float,
    checkpoint: Path,
    start: bytes | None = None,
    seed: int = 0,
    say: Callable[[str], None] = print,
) -> LumpNet:
    """The network after so many minutes, with averaged weights; goes on from a checkpoint.

    Parameters
    ----------
    groups : callable
        Gives groups of examples; asked again at every checkpoint, so that more may come.
    shares : sequence of float
        Of crops from each group.
    minutes : float
        Duration; the learning rate falls to nothing by then.
    checkpoint : Path
        Where the state is kept.
    start : bytes, optional
        ONNX file of the network to go on from, at a lower rate; else it begins from nothing.
    seed : int
        Of weights and crops.
    say : callable
        Takes a line of progress.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng, examples = np.random.default_rng(seed), _Drawn(groups(), shares)

    def batch() -> tuple[Any, Any]:
        made = [training_crop(examples(rng), rng) for _ in range(BATCH)]
        x, t = (torch.from_numpy(np.stack(column)) for column in zip(*made, strict=True))
        return x.contiguous(memory_format=torch.channels_last), t

    new = restored(start, (batch()[0] for _ in range(_FIRST))) if start else LumpNet()
    course = _begin(new, RATE_ON if start else RATE, checkpoint)
    rng = np.random.default_rng([seed, course.step])
    with ThreadPoolExecutor(1) as pool:
        following, saved = pool.submit(batch), time.monotonic()
        total: list[float] = []
        while course.seconds < 60 * minutes:
            begun = time.monotonic()
            x, t = following.result()
            if begun - saved > SAVE_S:
                _save(course, checkpoint)
                examples, saved = _Drawn(groups(), shares), time.monotonic()
                say(
                    f"{course.seconds:.0f} s, {course.step} steps, loss {np.mean(total):.4f}, "
                    f"{len(examples)} examples"
                )
                total = []
            following = pool.submit(batch)
            total.append(_step(course, x, t, course.rate(minutes)))
            course.seconds += time.monotonic() - begun
    _save(course, checkpoint)
    course.net.load_state_dict(course.average)
    course.net.eval()
    return course.net


def _begin(net: LumpNet, highest: float, checkpoint: Path) -> _Course:
    """A training from the network on, or from where the checkpoint is."""
    net = net.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(net.parameters(), highest, weight_decay=DECAY)
    course = _Course(net, optimiser, {}, highest)
    if checkpoint.exists():
        state = torch.load(checkpoint)
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
        course.average, course.step, course.seconds = (
            state[name] for name in ("average", "step", "seconds")
        )
    return course


def _save(course: _Course, checkpoint: Path) -> None:
    """Write the state, whole or not at all."""
    state = {
        "net": course.net.state_dict(),
        "optimiser": course.optimiser.state_dict(),
        "average": course.average,
        "step": course.step,
        "seconds": course.seconds,
    }
    part = checkpoint.with_suffix(".part")
    torch.save(state, part)
    part.rename(checkpoint)


def _step(course: _Course, x: Any, t: Any, rate: float) -> float:
    for group in course.optimiser.param_groups:
        group["lr"] = rate
    with torch.autocast("cpu", torch.bfloat16):
        y = course.net(x)
    loss = loss_of(y.float(), t)
    course.optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(course.net.parameters(), CLIP)
    course.optimiser.step()
    course.step += 1
    keep = KEEP if course.step > 4 * WARM_UP else 0.0
    for name, value in course.net.state_dict().items():
        if name in course.average and value.dtype.is_floating_point:
            course.average[name].mul_(keep).add_(value, alpha=1 - keep)
        else:
            course.average[name] = value.clone()
    return float(loss.item())
