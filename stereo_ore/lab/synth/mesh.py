"""Triangle meshes: spheres, boxes, mass properties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol
from typing import cast as cast_type

import numpy as np
import numpy.typing as npt

from stereo_ore.types import F64, I32, Mask


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) [m] and triangles (F, 3), counter-clockwise seen from outside."""

    vertices: F64
    triangles: I32

    def moved(self, R: F64, t: F64) -> Mesh:
        """The mesh with every vertex at R·v + t."""
        return Mesh(self.vertices @ R.T + t, self.triangles)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate(
            [m.triangles + np.int32(s) for m, s in zip(meshes, starts, strict=True)]
        ).astype(np.int32),
    )


@lru_cache(maxsize=8)
def icosphere(subdivisions: int) -> Mesh:
    """The unit sphere as an icosahedron whose triangles are split in four `subdivisions` times."""
    phi = (1 + 5**0.5) / 2
    v = np.array([(s, t * phi, 0) for s in (-1, 1) for t in (-1, 1)], float)
    vertices = np.concatenate([v, np.roll(v, 1, 1), np.roll(v, 2, 1)])
    i, j, k = np.array(np.meshgrid(*[np.arange(12)] * 3, indexing="ij")).reshape(3, -1)
    edge = np.linalg.norm(vertices[:, None] - vertices[None], axis=2) < 2.1
    face = (i < j) & (j < k) & edge[i, j] & edge[j, k] & edge[i, k]
    triangles = _outwards(vertices, np.stack([i, j, k], 1)[face])
    for _ in range(subdivisions):
        vertices, triangles = _split(vertices, triangles)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(vertices, triangles.astype(np.int32))


def _outwards(vertices: F64, triangles: I32) -> I32:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    return np.where(inward[:, None], triangles[:, ::-1], triangles)


def _split(vertices: F64, triangles: I32) -> tuple[F64, I32]:
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = vertices[unique].mean(1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True) / np.linalg.norm(vertices[0])
    ab, bc, ca = (len(vertices) + inverse.reshape(-1, 3)).T
    a, b, c = triangles.T
    faces = np.stack(
        [np.stack(f, 1) for f in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))], 1
    )
    return np.concatenate([vertices, middle]), faces.reshape(-1, 3)


def box(low: Sequence[float], high: Sequence[float], cell: float) -> Mesh:
    """An axis-aligned box whose faces are grids of cells no longer than `cell` [m]."""
    lo, hi = np.array(low, float), np.array(high, float)
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for at, flip in ((lo, True), (hi, False)):
            origin = lo.copy()
            origin[axis] = at[axis]
            faces.append(
                rectangle(
                    origin,
                    np.eye(3)[u] * (hi - lo)[u],
                    np.eye(3)[v] * (hi - lo)[v],
                    cell,
                    flip=flip,
                )
            )
    return merge(faces)


def rectangle(origin: F64, side_u: F64, side_v: F64, cell: float, flip: bool = False) -> Mesh:
    """The rectangle origin + a·side_u + b·side_v, 0 ≤ a, b ≤ 1, facing along side_u × side_v (or
    against it).
    """
    nu, nv = (max(1, int(np.ceil(np.linalg.norm(s) / cell))) for s in (side_u, side_v))
    a, b = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij")
    vertices = origin + a.reshape(-1, 1) * side_u + b.reshape(-1, 1) * side_v
    i = (np.arange(nu)[:, None] * (nv + 1) + np.arange(nv)).ravel()
    triangles = np.concatenate(
        [np.stack([i, i + nv + 1, i + nv + 2], 1), np.stack([i, i + nv + 2, i + 1], 1)]
    )
    return Mesh(vertices, (triangles[:, ::-1] if flip else triangles).astype(np.int32))


def volume_and_centre(mesh: Mesh) -> tuple[float, F64]:
    """Volume [m³] and centre of mass (3,) [m] of a closed mesh: the sum over signed tetrahedra to
    the origin.
    """
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    total = six_volumes.sum()
    return float(total / 6), ((a + b + c) * six_volumes[:, None]).sum(0) / (4 * total)


def callipers(mesh: Mesh) -> tuple[F64, float, float]:
    """Sorted sides of the smallest box around a mesh, and its longest and shortest calliper [m].

    The box and the shortest calliper are sought over the normals of the convex hull, one a cell of
    7°, the box's other two directions in steps of 3°, then 0.2° for the best: within about half a
    percent of the exact values.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(mesh.vertices)
    points = mesh.vertices[hull.vertices]
    longest = max(float(np.linalg.norm(points - p, axis=1).max()) for p in points)
    normals = hull.equations[:, :3] * np.where(hull.equations[:, 2:3] < 0, -1, 1)
    normals = normals[np.unique((normals * 8).round().astype(int), axis=0, return_index=True)[1]]
    widths, boxes = _boxes(points, normals, np.arange(0.0, 90.0, 3.0))
    best = normals[boxes.prod(2).min(0).argmin()][None]
    boxes = _boxes(points, best, np.arange(0.0, 90.0, 0.2))[1].reshape(-1, 3)
    return np.sort(boxes[boxes.prod(1).argmin()])[::-1], longest, float(widths.min())


def _boxes(points: F64, normals: F64, degrees: F64) -> tuple[F64, F64]:
    """Widths (M,) of points along normals (M, 3), and sides (angles, M, 3) of boxes turned about
    each normal.
    """
    u = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    a, b = u @ points.T, np.cross(normals, u) @ points.T
    widths = np.ptp(normals @ points.T, axis=1)
    turns = [(np.cos(t), np.sin(t)) for t in np.radians(degrees)]
    sides = [
        (widths, np.ptp(a * c + b * s, axis=1), np.ptp(b * c - a * s, axis=1)) for c, s in turns
    ]
    return widths, np.array(sides).transpose(0, 2, 1)


class RayCaster(Protocol):
    """What is used of Open3D's RaycastingScene."""

    def cast_rays(self, rays: Any) -> dict[str, Any]:
        """Hit distance, triangle, barycentric coordinates and normal of each ray."""

    def test_occlusions(self, rays: Any, tnear: float, tfar: float) -> Any:
        """Whether anything lies between tnear and tfar on each ray."""


def ray_caster(mesh: Mesh) -> RayCaster:
    """A ray caster over a mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(
        tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32))
    )
    return cast_type(RayCaster, scene)


def cast(caster: RayCaster, rays: npt.ArrayLike) -> dict[str, npt.NDArray[Any]]:
    """First hits of rays (..., 6), origin and direction; `t_hit` is inf where there is none."""
    import open3d as o3d

    found = caster.cast_rays(o3d.core.Tensor.from_numpy(np.ascontiguousarray(rays, np.float32)))
    return {name: value.numpy() for name, value in found.items()}


def blocked(caster: RayCaster, rays: npt.ArrayLike, reach: float = np.inf) -> Mask:
    """True for each ray (..., 6) that hits something before `reach`."""
    import open3d as o3d

    query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(rays, np.float32))
    return np.asarray(caster.test_occlusions(query, 0.0, reach).numpy())


def prism(start: F64, end: F64, radius: float, sides: int = 12) -> Mesh:
    """A closed prism of `sides` faces about the line from `start` to `end` [m]."""
    axis = (end - start) / np.linalg.norm(end - start)
    x = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    x /= np.linalg.norm(x)
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = radius * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(axis, x))
    vertices = np.concatenate([start + ring, end + ring, [start], [end]])
    k = np.arange(sides)
    following = (k + 1) % sides
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = (
        (k, following, following + sides),
        (k, following + sides, k + sides),
        (low, following, k),
        (high, k + sides, following + sides),
    )
    triangles: I32 = np.concatenate([np.stack(face, 1) for face in faces]).astype(np.int32)
    return Mesh(vertices, triangles)
