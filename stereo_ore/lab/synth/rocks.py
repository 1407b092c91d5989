"""Random broken rock: convex polyhedra with worn edges and a rough skin."""

from __future__ import annotations

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh, icosphere, volume_and_centre
from stereo_ore.types import F64

PROPORTIONS = {
    "block": (1.0, 0.80, 0.64),
    "chunk": (1.0, 0.86, 0.74),
    "slab": (1.0, 0.74, 0.38),
    "long": (1.0, 0.48, 0.42),
}
"""Longest, middle and shortest dimension of each kind of lump, before each is varied by a fifth."""
LARGEST_RADIUS, _THICKER = 1.5, (1.0, 1.08, 1.25)
"""Of an angular rock, before it is stretched: where no plane bounds it, and how much wider its tips
must lie for the proportions of the body."""


def rock(
    rng: np.random.Generator,
    shape: str,
    longest_m: float,
    subdivisions: int = 5,
    angular: bool = False,
) -> Mesh:
    """A closed rock of a kind in `PROPORTIONS`, its centre of mass in the origin, its long axis
    along x.

    The distance of the skin in direction d is the smooth minimum over random planes n·x = h, r(d) =
    (Σ max(n·d, 0)/h)^p)^(−1/p), roughened by four octaves of noise; the result is stretched to the
    proportions. An angular one is bounded by fewer planes at less equal distances, and fills less
    of its box.
    """
    sphere = icosphere(subdivisions)
    d = sphere.vertices
    normals, distances, sharpness = (_break if angular else _hew)(rng)
    radius = (np.maximum(d @ normals.T, 0) / distances) ** sharpness
    radius = (radius.sum(1) + (LARGEST_RADIUS**-sharpness if angular else 0.0)) ** (-1 / sharpness)
    radius = radius * (1 + roughness(rng, d * radius[:, None]))
    proportions = np.array(PROPORTIONS[shape]) * (_THICKER if angular else 1.0)
    vertices = d * radius[:, None] * proportions * rng.uniform(0.82, 1.18, 3)
    vertices = vertices @ _small_shear(rng)
    vertices *= longest_m / np.ptp(vertices, axis=0).max()
    mesh = Mesh(vertices, sphere.triangles)
    return Mesh(vertices - volume_and_centre(mesh)[1], sphere.triangles)


def _hew(rng: np.random.Generator) -> tuple[F64, F64, float]:
    """Unit normals (P, 3) and distances (P,) of planes, those of a cube among them, and how sharp
    their edges are.
    """
    count, sharpness = int(rng.integers(10, 22)), rng.uniform(22, 70)
    normals = _directions(rng, count)
    normals = np.concatenate([normals, np.eye(3), -np.eye(3)])
    return normals, rng.uniform(0.8, 1.1, count + 6), sharpness


def _break(rng: np.random.Generator) -> tuple[F64, F64, float]:
    """As `_hew`, without a cube's planes; bodies so made fill 0.43 to 0.49 of their box, as crushed
    rock does.
    """
    count, sharpness = int(rng.integers(8, 15)), rng.uniform(22, 70)
    nearest = rng.uniform(0.6, 0.8)
    return _directions(rng, count), rng.uniform(nearest, 1.1, count), sharpness


def _directions(rng: np.random.Generator, count: int) -> F64:
    normals = rng.normal(size=(count, 3))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def roughness(rng: np.random.Generator, xyz: F64, amplitude: float = 0.055) -> F64:
    """Four octaves of lattice noise at (N, 3) points of a body of size 2."""
    from scipy.ndimage import map_coordinates

    total = np.zeros(len(xyz))
    for octave in range(4):
        lattice = rng.uniform(-1, 1, (16, 16, 16))
        at = (xyz * 1.3 * 2**octave + rng.uniform(0, 16, 3)).T
        total += amplitude * 0.5**octave * map_coordinates(lattice, at, order=1, mode="grid-wrap")
    return total


def random_rotation(rng: np.random.Generator) -> F64:
    """A uniformly distributed rotation (3, 3), from a random unit quaternion."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _small_shear(rng: np.random.Generator) -> F64:
    """Skews a body a little, so that no two faces are exactly parallel."""
    return np.eye(3) + np.triu(rng.uniform(-0.2, 0.2, (3, 3)), 1)
