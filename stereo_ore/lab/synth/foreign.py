"""What hangs or stands over a screen and is no ore: a breaker's hammer on its boom, a chain, a
post.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh, merge, prism
from stereo_ore.lab.synth.screen import Screen
from stereo_ore.types import F64

TOOL = 255
"""Instance of all of them."""
Kind = Literal["hammer", "chain", "post"]
LARGE_M = 3.0
"""Width of the screen for which the lengths below are made; those of others go with it."""


def foreign_body(kind: Kind, screen: Screen, eye: F64, rng: np.random.Generator) -> Mesh:
    """A body in the screen's frame.

    Parameters
    ----------
    kind
        "hammer": a chisel under a box, on a boom that leads off the screen, away from the camera;
        "chain": links from above, hanging free; "post": standing on the screen.
    screen : Screen
        What it is over.
    eye : (3,) array
        Where the camera is.
    rng : numpy.random.Generator
        Draws place, pose and size.
    """
    scale, half = screen.size[0] / LARGE_M, np.array(screen.size) / 2
    xy = rng.uniform(-0.6, 0.6, 2) * half
    if kind == "hammer":
        return _hammer(np.array([*xy, rng.uniform(0.05, 0.45) * scale]), scale, eye, rng)
    if kind == "chain":
        return _chain(np.array([*xy, rng.uniform(0.1, 0.5) * scale]), scale)
    foot = half * rng.uniform(0.3, 0.8, 2) * rng.choice([-1, 1], 2)
    return prism(
        np.array([*foot, -0.05 * scale]),
        np.array([*foot, rng.uniform(0.6, 1.3) * scale]),
        rng.uniform(0.06, 0.1) * scale,
        sides=4,
    )


def _hammer(tip: F64, scale: float, eye: F64, rng: np.random.Generator) -> Mesh:
    lean, turn = rng.uniform(0, 0.4), rng.uniform(0, 2 * np.pi)
    axis = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)])
    shoulder, top = tip + 0.4 * scale * axis, tip + 0.9 * scale * axis
    away = np.arctan2(*(tip - eye)[1::-1]) + rng.uniform(-0.9, 0.9)
    end = top + scale * np.array([3.0 * np.cos(away), 3.0 * np.sin(away), 0.6])
    return merge(
        [
            prism(tip, shoulder, 0.05 * scale),
            prism(shoulder, top, 0.15 * scale, sides=4),
            prism(top - 0.1 * scale * axis, end, 0.14 * scale, sides=4),
        ]
    )


def _chain(low: F64, scale: float) -> Mesh:
    """Links one above the other, each turned by a quarter against the one before."""
    step, links = 0.09 * scale, []
    for number in range(18):
        a = low + np.array([0, 0, number * step])
        side = np.eye(3)[number % 2] * 0.03 * scale
        up = np.array([0, 0, 1.15 * step])
        links += [prism(a + sign * side, a + sign * side + up, 0.014 * scale) for sign in (-1, 1)]
    return merge(links)
