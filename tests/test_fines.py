"""How much of the screen is under fines and mud: none of a clean one, and the more the more lies on
it; ties, lumps and bodies are none."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import small_spec
from screens import DISTANCE, OPENING, PITCH, WIDTH, Screen, draw

from stereo_ore.chain import Chain
from stereo_ore.config import GrizzlyConfig
from stereo_ore.lab import synth
from stereo_ore.lab.synth.mesh import Mesh
from stereo_ore.lab.synth.model import BACKGROUND, Part, assembled, build_model
from stereo_ore.lab.synth.rig import eyes, ideal_rig, reference_rectification
from stereo_ore.lab.synth.scene import pair_of, site_of
from stereo_ore.record import record
from stereo_ore.stages import grizzly
from stereo_ore.stages.fines import fines_share
from stereo_ore.transforms import inverse
from stereo_ore.types import Grizzly, Mask, OreMap, Site, Surface, Volume

CLEAN = Screen(noise_px=0.1)
SLOTS = Site(plane=CLEAN.plane, opening_m=OPENING, bar_width_m=WIDTH)


def volume_of(screen: Screen) -> Volume:
    """About the inside of the screen, as far as its hole reaches."""
    axes = screen.axes
    T = np.eye(4)
    T[:3, :3] = axes
    T[:3, 3] = -axes @ [0, 0, DISTANCE]
    half = np.array([screen.half, screen.half])
    return Volume(T, np.array([*-half, -0.3]), np.array([*half, 1.0]))


def places(surface: Surface, screen: Screen) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the plane, along the bars and across them [m]."""
    depth = screen.plane.offset / surface.on_rays(screen.plane.normal)
    middle = [axis @ [0, 0, DISTANCE] for axis in screen.axes[:2]]
    s, c = (
        surface.on_rays(axis) * depth - m for axis, m in zip(screen.axes[:2], middle, strict=True)
    )
    return s, c


def covered(surface: Surface, screen: Screen, part: Mask, height_m: float = 0.03) -> Surface:
    """The surface with a sheet over a part of the screen."""
    depth = (screen.plane.offset + height_m) / surface.on_rays(screen.plane.normal)
    ray = surface.xyz / surface.xyz[..., 2:]
    xyz = np.where(part[..., None], ray * depth[..., None], surface.xyz)
    return replace(surface, xyz=xyz.astype(np.float32))


def found(surface: Surface, site: Site = SLOTS) -> Grizzly:
    return grizzly.find(surface, site, GrizzlyConfig())


def share(
    surface: Surface,
    grid: Grizzly,
    screen: Screen = CLEAN,
    labels: np.ndarray | None = None,
    foreign: Mask | None = None,
) -> float:
    shape = surface.sigma_z.shape
    ore_map = OreMap(np.zeros(shape, np.int16) if labels is None else labels)
    none = np.zeros(shape, np.bool_) if foreign is None else foreign
    told = fines_share(surface, grid, volume_of(screen), ore_map, none)
    assert told is not None
    return told


@pytest.mark.parametrize("tilt", [0.0, 0.4])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_it_is_none_on_a_clean_screen_and_grows_with_what_lies_on_it(
    tilt: float, yaw: float
) -> None:
    screen = replace(CLEAN, tilt=tilt, yaw=yaw)
    surface, _ = draw(screen)
    clean = found(surface, replace(SLOTS, plane=screen.plane))
    s, c = places(surface, screen)
    inside = (np.abs(s) < screen.half) & (np.abs(c) < screen.half)
    shares = [
        share(covered(surface, screen, inside & (c < screen.half * (2 * part - 1))), clean, screen)
        for part in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    assert shares[0] < 0.01
    assert np.all(np.diff(shares) > 0.1)
    assert shares[2] == pytest.approx(0.5, abs=0.12)
    assert shares[4] > 0.95


def test_it_is_the_same_for_any_part_of_the_pixels() -> None:
    surface, _ = draw(CLEAN)
    clean = found(surface)
    s, _ = places(surface, CLEAN)
    mud = covered(surface, CLEAN, np.abs(s) < 0.2)
    nearer = replace(surface, xyz=np.repeat(np.repeat(mud.xyz, 2, 0), 2, 1),
                     bgr=np.repeat(np.repeat(mud.bgr, 2, 0), 2, 1),
                     sigma_z=np.repeat(np.repeat(mud.sigma_z, 2, 0), 2, 1),
                     rig=twice(surface))  # fmt: skip
    assert share(nearer, clean) == pytest.approx(share(mud, clean), abs=0.03)


def twice(surface: Surface) -> object:
    rig = surface.rig
    return replace(rig, width=2 * rig.width, height=2 * rig.height, fx=2 * rig.fx, fy=2 * rig.fy,
                   cx=2 * rig.cx + 0.5, cy=2 * rig.cy + 0.5)  # fmt: skip


def test_ties_and_beams_are_no_fines() -> None:
    surface, _ = draw(CLEAN)
    clean = found(surface)
    s, c = places(surface, CLEAN)
    inside = np.abs(c) < CLEAN.half
    ties = inside & ((np.abs(s - 0.2) < 0.02) | (np.abs(s + 0.15) < 0.02))
    assert share(covered(surface, CLEAN, ties, -0.005), clean) < 0.01
    beam = inside & (np.abs(s) > CLEAN.half - 0.14)
    assert share(covered(surface, CLEAN, beam, 0.0), clean) < 0.02


def test_grains_on_bars_count_and_what_lies_far_beneath_does_not() -> None:
    surface, _ = draw(CLEAN)
    clean = found(surface)
    s, c = places(surface, CLEAN)
    inside = (np.abs(s) < 0.45) & (np.abs(c) < 0.45)
    on_bars = inside & (np.abs(c - PITCH * np.round(c / PITCH)) < WIDTH / 2)
    assert share(covered(surface, CLEAN, on_bars, 0.06), clean) == pytest.approx(
        WIDTH / PITCH, abs=0.05
    )
    gaps = inside & ~on_bars
    assert share(covered(surface, CLEAN, gaps, 0.0), clean) == pytest.approx(
        1 - WIDTH / PITCH, abs=0.1
    )
    assert share(covered(surface, CLEAN, gaps, -0.05), clean) < 0.01


def test_what_lumps_and_bodies_hide_is_not_counted() -> None:
    screen = replace(CLEAN, lumps=((0.0, 0.1, 0.1, 0.15),))
    surface, labels = draw(screen)
    clean = found(draw(CLEAN)[0])
    assert share(surface, clean, labels=labels) < 0.02
    assert share(surface, clean, foreign=labels > 0) < 0.02
    assert share(surface, clean) > 0.05


def test_of_a_grid_the_bars_across_are_no_fines() -> None:
    screen = replace(CLEAN, cross=OPENING)
    surface, _ = draw(screen)
    site = replace(SLOTS, cross_opening_m=OPENING)
    grid = found(surface, site)
    assert grid.cross_bars is not None
    assert share(surface, grid, screen) < 0.02
    s, c = places(surface, screen)
    whole = (np.abs(s) < screen.half) & (np.abs(c) < screen.half)
    assert share(covered(surface, screen, whole), grid, screen) > 0.9


def test_it_is_not_told_where_the_screen_is_not_known() -> None:
    surface, _ = draw(CLEAN)
    clean, volume = found(surface), volume_of(CLEAN)
    shape = surface.sigma_z.shape
    rest = OreMap(np.zeros(shape, np.int16)), np.zeros(shape, np.bool_)
    assert fines_share(surface, clean, None, *rest) is None
    assert fines_share(surface, replace(clean, bars=None), volume, *rest) is None
    assert fines_share(surface, replace(clean, opening_m=None), volume, *rest) is None
    hidden = OreMap(np.ones(shape, np.int16)), rest[1]
    assert fines_share(surface, clean, volume, *hidden) is None


# --- in the chain


def with_mud(spec: synth.SceneSpec, part: float) -> dict[str, object] | None:
    """Record's screen of a made-up scene whose screen lies under a sheet up to a part of it."""
    model, half = build_model(spec), np.array(spec.screen.size) / 2
    if part:
        cells = 40
        x, y = np.meshgrid(np.linspace(-1, 2 * part - 1, cells), np.linspace(-1, 1, cells))
        z = 0.01 + 0.004 * np.random.default_rng(1).normal(size=x.shape)
        i = np.arange(cells * (cells - 1)).reshape(cells - 1, cells)[:, :-1].ravel()
        corners = np.stack([x * half[0], y * half[1], z], -1).reshape(-1, 3)
        faces = [(i, i + 1, i + cells), (i + 1, i + cells + 1, i + cells)]
        mesh = Mesh(corners, np.concatenate([np.stack(f, 1) for f in faces]).astype(np.int32))
        mud = Part(mesh, "earth", BACKGROUND, np.eye(3), np.zeros(3))
        rng = np.random.default_rng(spec.seed)
        model = assembled([*model.parts, mud], model.lumps, rng, 2 * max(spec.screen.size))
    calibration = ideal_rig(spec)
    rectified = reference_rectification(calibration)
    views = eyes(calibration, rectified, inverse(spec.T_world_screen) @ spec.camera.T_world_left)
    site = site_of(spec, rectified)
    result = Chain(calibration, site)(pair_of(spec, model, *views[:2]))
    told = record(result, site)["grizzly"]
    assert told["fines_share"] == (result.fines_share and round(result.fines_share, 6))
    return told


def test_mud_on_a_made_up_screen_is_counted_in_the_record() -> None:
    shares = [with_mud(small_spec(0), part)["fines_share"] for part in (0.0, 0.5)]
    assert shares[0] < 0.02
    assert shares[1] == pytest.approx(0.5, abs=0.15)
