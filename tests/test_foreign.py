"""What is in view and is no ore: places that the site names, and bodies over the screen."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import small_spec

from stereo_ore.chain import Chain
from stereo_ore.config import Config, ForeignConfig
from stereo_ore.errors import ConfigError
from stereo_ore.io.site import load_site, save_site
from stereo_ore.lab import synth
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.stages import foreign
from stereo_ore.stages.foreign.places import distances
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import (
    Capsule,
    FrameResult,
    KeepOut,
    OreMap,
    Polygon,
    Reason,
    Strike,
    StrikePlan,
    Surface,
    Volume,
)

SCENE = Path(__file__).parents[1] / "data" / "paper_03"
OPENING_M = 0.3


def config(**changes: object) -> Config:
    return Config(foreign=ForeignConfig(**changes))


# --- places of the site

ROD = Capsule(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]), 0.1)
BOX = Volume(np.eye(4), np.array([-1.0, -1, 1]), np.array([1.0, 1, 2]))


@pytest.mark.parametrize(
    ("body", "point", "expected"),
    [
        (ROD, (0.1, 0.0, 1.5), 0.0),
        (ROD, (0.3, 0.0, 1.5), 0.2),
        (ROD, (0.0, 0.0, 2.3), 0.2),
        (replace(ROD, flat=True), (0.3, 0.0, 1.5), 0.2),
        (replace(ROD, flat=True), (0.0, 0.0, 2.3), np.inf),
        (BOX, (0.0, 0.0, 1.5), 0.0),
        (BOX, (1.3, 0.0, 2.4), 0.5),
        (Polygon(np.array([(0.0, 0), (1, 0), (1, 1)])), (0.0, 0.0, 1.0), np.inf),
    ],
)
def test_distances_from_bodies(
    body: Capsule | Volume | Polygon, point: tuple[float, ...], expected: float
) -> None:
    found = distances(np.array([point]), [KeepOut("it", body)])
    assert found == pytest.approx([expected])
    if not isinstance(body, Polygon):
        assert body.contains(np.array([point])).tolist() == [expected == 0]


ENTRIES = [
    {"name": "boom", "shape": "capsule", "frame": "arm", "from_m": [0, 0, 1], "to_m": [0, 1, 1],
     "radius_m": 0.2},
    {"name": "post", "shape": "cylinder", "frame": "camera", "from_m": [1, 0, 2],
     "to_m": [1, 0, 3], "radius_m": 0.1},
    {"name": "cabinet", "shape": "box", "frame": "arm", "min_m": [1, 1, 0], "max_m": [2, 2, 1]},
    {"name": "lamp", "shape": "polygon", "points_px": [[0, 0], [100, 0], [50, 80]]},
]  # fmt: skip


def site_file(folder: Path, entries: object) -> Path:
    document = yaml.safe_load((SCENE / "site.yaml").read_text()) | {"keep_out": entries}
    (folder / "site.yaml").write_text(json.dumps(document))
    return folder / "site.yaml"


def test_places_are_read_into_the_camera_frame_and_survive_a_round_trip(tmp_path: Path) -> None:
    site = load_site(site_file(tmp_path, ENTRIES))
    boom, post, cabinet, lamp = (place.body for place in site.keep_out)
    assert [place.name for place in site.keep_out] == ["boom", "post", "cabinet", "lamp"]
    assert isinstance(boom, Capsule)
    assert isinstance(post, Capsule)
    assert isinstance(cabinet, Volume)
    assert isinstance(lamp, Polygon)
    assert transform_points(site.T_arm_camera, boom.start) == pytest.approx([0, 0, 1], abs=1e-6)
    assert (boom.flat, post.flat, post.end.tolist()) == (False, True, [1, 0, 3])
    inside = transform_points(inverse(site.T_arm_camera), [1.5, 1.5, 0.5])
    assert cabinet.contains(inside[None]).all()
    save_site(site, tmp_path / "again.yaml")
    again = load_site(tmp_path / "again.yaml").keep_out
    assert [place.name for place in again] == [place.name for place in site.keep_out]
    assert isinstance(again[0].body, Capsule)
    assert again[0].body.end == pytest.approx(boom.end)


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({**ENTRIES[0], "radius_m": 0}, "radius_m"),
        ({**ENTRIES[0], "to_m": [0, 0, 1]}, "one point"),
        ({**ENTRIES[2], "max_m": [0, 2, 1]}, "must be less"),
        ({**ENTRIES[0], "shape": "sphere"}, "sphere"),
        ({**ENTRIES[3], "points_px": [[0, 0], [1, 1]]}, "points_px"),
        ({**ENTRIES[0], "to_m": [0, 1000, 1]}, "millimetres"),
        ({**ENTRIES[0], "radius": 1}, "radius"),
    ],
)
def test_a_broken_place_is_refused_by_name(entry: object, told: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as fault:
        load_site(site_file(tmp_path, [entry]))
    assert "keep_out" in str(fault.value)
    assert told in str(fault.value)


def test_names_are_there_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'boom' is there 2 times"):
        load_site(site_file(tmp_path, [ENTRIES[0], dict(ENTRIES[0])]))


# --- lumps and strikes beside a body


def strike_at(x: float) -> Strike:
    return Strike(np.array([x, 0.0, 2.0]), np.array([0, 0, 1.0]), 0.0, 0.0, 0.5)


def test_strikes_keep_clear_of_bodies() -> None:
    known = foreign.Foreign(np.zeros((2, 2), bool), np.zeros((0, 3)), (), (KeepOut("rod", ROD),))
    plans = [
        StrikePlan((strike_at(0.15), strike_at(0.5))),
        StrikePlan((strike_at(0.15),)),
        StrikePlan((), (Reason("TOO_STEEP", ""),)),
    ]
    one, none, as_it_was = foreign.clear_of(plans, known, OPENING_M, ForeignConfig())
    assert [strike.point[0] for strike in one.strikes] == [0.5]
    assert [reason.code for reason in none.reasons] == ["NEAR_FOREIGN_BODY"]
    assert as_it_was is plans[2]
    seen = replace(known, places=(), xyz=np.array([[0.6, 0.0, 2.0]]), bodies=())
    assert foreign.clear_of(plans, seen, OPENING_M, ForeignConfig()) == tuple(plans)


def test_lumps_on_a_body_are_none_and_ids_have_no_gaps(flat_plane_pair) -> None:
    labels = np.zeros((320, 480), np.int16)
    labels[50:100, 50:100], labels[150:200, 50:100], labels[150:200, 150:200] = 1, 2, 3
    mask = np.zeros((320, 480), bool)
    mask[40:110, 40:80], mask[150:200, 150:160] = True, True
    rig = flat_plane_pair.pair.rig
    surface = Surface(
        np.zeros((320, 480, 3), np.float32), flat_plane_pair.pair.left,
        np.zeros((320, 480), np.float32), 0, 0, rig,
    )  # fmt: skip
    body = foreign.Foreign(mask, np.zeros((0, 3)))
    found = foreign.cleared(OreMap(labels, frozenset({2, 3})), body, surface)
    assert np.unique(found.labels).tolist() == [0, 1, 2]
    assert (found.labels[150:200, 50:100] == 1).all()
    assert (found.labels[150:200, 160:200] == 2).all()
    assert not found.labels[mask].any()
    assert (found.cut, found.diagnostics["dropped_foreign"]) == (frozenset({1, 2}), 1)


# --- bodies over a screen


@pytest.fixture(scope="module", params=["hammer", "chain", "post"])
def scene(request: pytest.FixtureRequest) -> synth.Scene:
    # A thin chain hardly has points: of nine seeds three are told, and none has ore on it.
    seed = 5 if request.param == "chain" else 4
    return synth.scene(replace(small_spec(3), seed=seed, foreign=(request.param,)))


def on_tool(result: FrameResult, scene: synth.Scene) -> list[int]:
    assert result.ore_map is not None
    tool = scene.instance == TOOL
    return [
        ore.id
        for ore in result.ores
        if (tool & (result.ore_map.labels == ore.id)).sum()
        > 0.2 * (result.ore_map.labels == ore.id).sum()
    ]


def test_a_body_over_the_screen_is_told_and_is_no_ore(scene: synth.Scene) -> None:
    assert (scene.instance == TOOL).sum() > 300
    result = Chain(scene.calibration, scene.site)(scene.pair)
    assert (result.status, on_tool(result, scene)) == ("ok", [])
    assert {reason.code for reason in result.reasons} == {"FOREIGN_BODY"}
    (body, *_) = result.foreign
    assert body.source == "image"
    u, v = body.outline_px.mean(0).round().astype(int)
    near = (scene.instance == TOOL)[v - 25 : v + 25, u - 25 : u + 25]
    assert near.any()


def test_a_body_that_covers_much_withholds_all_targets(scene: synth.Scene) -> None:
    free = Chain(scene.calibration, scene.site)(scene.pair)
    held = Chain(scene.calibration, scene.site, config(max_share=0.0))(scene.pair)
    assert held.targets == ()
    assert len(held.ores) == len(free.ores) > 0
    assert {reason.code for reason in held.reasons} == {"FOREIGN_BODY"}


def test_a_place_of_the_site_is_no_ore(scene: synth.Scene) -> None:
    v, u = np.nonzero(scene.instance == TOOL)
    corners = np.array([(u.min() - 4, v.min() - 4), (u.max() + 4, v.min() - 4),
                        (u.max() + 4, v.max() + 4), (u.min() - 4, v.max() + 4)], float)  # fmt: skip
    site = replace(scene.site, keep_out=(KeepOut("tool", Polygon(corners)),))
    result = Chain(scene.calibration, site, config(find=False))(scene.pair)
    assert on_tool(result, scene) == []
    assert [(body.name, body.source) for body in result.foreign] == [("tool", "site")]
    assert result.reasons == ()


def test_nothing_is_foreign_where_there_is_only_ore(synth_scene: synth.Scene) -> None:
    result = Chain(synth_scene.calibration, synth_scene.site)(synth_scene.pair)
    assert (result.foreign, result.reasons) == ((), ())
