"""Lumps that a physics engine (MuJoCo, extra ``train``) drops on a grizzly, wave after wave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh
from stereo_ore.types import F64

STEP_S, WAVE, FALL_STEPS, REST_STEPS = 0.006, 7, 130, 160
"""Time step; lumps released at once; steps that a wave falls, and that the last one rests."""
FRICTION, DENSITY, HULL = 0.9, 2700.0, 40
"""Of rock on rock and steel; kg/m³; vertices of the convex hull that collides."""
PARKED_M = 60.0
"""Height at which lumps wait for their wave."""
OFF, LOST_M = 1.6, -0.6
"""Lumps farther out than so many spreads, or deeper than this [m], are gone."""

TumbledBox = tuple[F64, F64]
"""Lowest and highest corner of a fixed, axis-aligned body [m]."""
Pose = tuple[F64, F64]
"""Rotation (3, 3) and position (3,) of a body."""


def tumble(
    meshes: Sequence[Mesh],
    fixed: Sequence[TumbledBox],
    spread: tuple[float, float],
    rng: np.random.Generator,
    stops: Sequence[int],
) -> Iterator[dict[int, Pose]]:
    """Rest poses of the lumps that lie within |x|, |y| ≤ spread, each time so many were released.

    Parameters
    ----------
    meshes : sequence of Mesh
        Lumps, centres of mass in their origins; they collide as their convex hulls.
    fixed : sequence of Box
        The screen.
    spread : tuple of float
        Half the sides [m] of the rectangle that lumps are dropped over.
    rng : Generator
        Places and turns.
    stops : sequence of int
        Numbers of lumps after which to look, ascending.
    """
    import mujoco

    model = _world(meshes, fixed)
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    released = 0
    for stop in stops:
        while released < stop:
            wave = range(released, min(released + WAVE, stop))
            _release(model, data, meshes, wave, spread, rng)
            released = wave.stop
            for _ in range(FALL_STEPS):
                mujoco.mj_step(model, data)
        for _ in range(REST_STEPS):
            data.qvel *= 0.97
            mujoco.mj_step(model, data)
        yield _at_rest(data, meshes[:released], spread)


def _world(meshes: Sequence[Mesh], fixed: Sequence[TumbledBox]) -> Any:
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = 12
    for low, high in fixed:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(low + high) / 2,
            size=(high - low) / 2,
            friction=[FRICTION, 0.01, 0.001],
        )
    for number, mesh in enumerate(meshes):
        hull = mesh.vertices[:: max(1, len(mesh.vertices) // 700)]
        spec.add_mesh(name=f"m{number}", uservert=hull.ravel().tolist(), maxhullvert=HULL)
        body = spec.worldbody.add_body(pos=[3.0 * number, 0, PARKED_M], gravcomp=1.0)
        body.add_freejoint()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"m{number}",
            density=DENSITY,
            friction=[FRICTION, 0.01, 0.001],
            condim=3,
        )
    return spec.compile()


def _release(
    model: Any,
    data: Any,
    meshes: Sequence[Mesh],
    wave: range,
    spread: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """Let a wave of lumps fall from just over those that lie there."""
    fallen = data.qpos.reshape(-1, 7)[: wave.start, :3]
    inside = (np.abs(fallen[:, :2]) < np.array(spread) * OFF).all(1)
    top = max(float(fallen[inside, 2].max(initial=0.0)), 0.0)
    for number in wave:
        size = float(np.ptp(meshes[number].vertices, axis=0).max())
        q = rng.normal(size=4)
        top += 0.62 * size
        place = rng.uniform(-1, 1, 2) * np.array(spread)
        data.qpos[7 * number : 7 * number + 7] = [*place, top, *(q / np.linalg.norm(q))]
        data.qvel[6 * number : 6 * number + 6] = 0
        model.body_gravcomp[number + 1] = 0.0
        top += 0.2 * size


def _at_rest(data: Any, meshes: Sequence[Mesh], spread: tuple[float, float]) -> dict[int, Pose]:
    """Poses of the lumps that did not fall through the screen or off it."""
    found = {}
    for number in range(len(meshes)):
        R, t = data.xmat[number + 1].reshape(3, 3).copy(), data.xpos[number + 1].copy()
        if (np.abs(t[:2]) < np.array(spread) * OFF).all() and LOST_M < t[2] < PARKED_M / 2:
            found[number] = (R, t)
    return found
