"""Site files: what they mean in the camera frame, round trips, every kind of mistake."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereo_ore.errors import ConfigError
from stereo_ore.io.calibration.geometry import from_vector
from stereo_ore.io.site import load_site, save_arm, save_site
from stereo_ore.io.site_sections import HandEyeRecord
from stereo_ore.transforms import inverse, rotation_fault, transform_points
from stereo_ore.types import BarLine, Plane, Site, Volume

EXAMPLE = Path(__file__).parents[1] / "calib" / "site.yaml"
RECORD = HandEyeRecord(method="touched points", used=5, dropped=("p3",), rms_mm=4.2, max_mm=7.5)


def write(folder: Path, text: str = "", **changes: object) -> Path:
    """The example with changes by dotted key, or a text of its own."""
    document = yaml.safe_load(text or EXAMPLE.read_text())
    for key, value in changes.items():
        *sections, leaf = key.split("__")
        part = document
        for section in sections:
            part = part[section]
        part[leaf] = value
    path = folder / "site.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def refused(path: Path) -> str:
    with pytest.raises(ConfigError) as fault:
        load_site(path)
    assert "site.yaml" in str(fault.value)
    return str(fault.value)


def test_the_example_is_in_the_camera_frame() -> None:
    site = load_site(EXAMPLE)
    assert site.plane is not None
    assert site.volume is not None
    origin_of_arm = transform_points(inverse(site.T_arm_camera), [0.0, 0.0, 0.0])
    assert site.plane.height(origin_of_arm) == pytest.approx(0, abs=1e-9)
    assert site.plane.height([0.0, 0.0, 0.0]) == pytest.approx(2.6)
    assert site.volume.contains(
        transform_points(inverse(site.T_arm_camera), [[0, 0, 0.5], [0, 0, 1.5]])
    ).tolist() == [True, False]
    assert (site.opening_m, site.bar_width_m, site.background) == (0.30, 0.075, None)


def test_plane_and_volume_in_the_camera_frame(tmp_path: Path) -> None:
    plane = {"frame": "camera", "normal": [0.0, 0.0, 2.0], "offset_m": 5.0}
    box = {"frame": "camera", "min_m": [-1, -1, 1], "max_m": [1, 1, 3]}
    site = load_site(write(tmp_path, grizzly__plane=plane, working_volume=box))
    assert site.plane is not None
    assert (site.plane.normal.tolist(), site.plane.offset) == ([0, 0, -1], -2.5)
    assert np.array_equal(site.volume.T_box_camera, np.eye(4))


def test_the_plane_may_be_auto_and_all_may_be_absent(tmp_path: Path) -> None:
    assert load_site(write(tmp_path, grizzly__plane="auto")).plane is None
    empty = load_site(write(tmp_path, "{format: stereo_ore/site, version: 1}"))
    assert empty == Site()


def test_a_grid_has_two_openings_and_survives_a_round_trip(tmp_path: Path) -> None:
    changes = {"opening_m": None, "openings_m": [0.3, 0.4], "bar_profile": "round"}
    site = load_site(
        write(tmp_path, **{f"grizzly__{key}": value for key, value in changes.items()})
    )
    assert (site.opening_m, site.cross_opening_m, site.bar_profile) == (0.3, 0.4, "round")
    save_site(site, tmp_path / "again.yaml")
    again = load_site(tmp_path / "again.yaml")
    assert (again.opening_m, again.cross_opening_m, again.bar_profile) == (0.3, 0.4, "round")


def test_the_background_stands_beside_the_site_file(tmp_path: Path) -> None:
    site = load_site(write(tmp_path, background="empty.npz"))
    assert site.background == tmp_path / "empty.npz"
    save_site(site, tmp_path / "again.yaml")
    assert load_site(tmp_path / "again.yaml").background == site.background


number = st.floats(-0.6, 0.6)


@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(turn=st.tuples(number, number, number), offset=st.floats(0.5, 4), arm=st.booleans())
def test_written_and_read_again_is_the_same(turn, offset: float, arm: bool, tmp_path: Path) -> None:
    T = from_vector(np.array([np.pi - 0.5 + turn[0], turn[1], turn[2], 1.0, -0.5, 3.0]))
    normal = np.array([turn[0], turn[1], -1.0])
    normal /= np.linalg.norm(normal)
    box = (np.array([-5.0, -5, -5]), np.array([5.0, 5, 5]))
    along = np.cross(normal, (0.0, 1, 0))
    bar = BarLine(-offset * normal, along / np.linalg.norm(along))
    volume, plane = Volume(T if arm else np.eye(4), *box), Plane(normal, -offset)
    site = Site(T, volume, plane, 0.3, 0.07, None, *box, bar=bar)
    save_site(site, tmp_path / "site.yaml", RECORD)
    again = load_site(tmp_path / "site.yaml")
    assert np.array_equal(again.T_arm_camera, T)
    assert np.array_equal(again.volume.T_box_camera, site.volume.T_box_camera)
    assert (again.plane.normal.tolist(), again.plane.offset) == (normal.tolist(), -offset)
    assert np.allclose(again.bar.point, bar.point, atol=1e-12)
    assert np.allclose(again.bar.direction, bar.direction, atol=1e-12)
    assert (again.opening_m, again.reach_min_m.tolist()) == (0.3, box[0].tolist())


def test_a_volume_of_another_frame_is_that_of_the_screen(tmp_path: Path) -> None:
    turned = from_vector(np.array([0.1, 0, 0, 0, 0, 2.0]))
    volume = Volume(turned, np.array([-1.0, -1, 0]), np.array([1.0, 1, 4]))
    save_site(Site(volume=volume), tmp_path / "site.yaml")
    again = load_site(tmp_path / "site.yaml").volume
    assert again is not None
    assert np.array_equal(again.T_box_camera, turned)
    document = yaml.safe_load((tmp_path / "site.yaml").read_text())
    del document["screen_from_camera"]
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(document))
    assert "screen_from_camera is not given" in refused(tmp_path / "site.yaml")


def test_a_new_arm_keeps_what_the_arm_frame_holds(tmp_path: Path) -> None:
    old = load_site(EXAMPLE)
    shift = from_vector(np.array([0, 0, 0, 0, 0, 0.1]))
    save_arm(shift @ old.T_arm_camera, RECORD, tmp_path / "site.yaml", EXAMPLE)
    new = load_site(tmp_path / "site.yaml")
    assert new.volume.min_m.tolist() == old.volume.min_m.tolist()
    assert new.plane.offset == pytest.approx(old.plane.offset - 0.1)
    assert yaml.safe_load((tmp_path / "site.yaml").read_text())["hand_eye"]["rms_mm"] == 4.2
    save_arm(old.T_arm_camera, RECORD, tmp_path / "bare.yaml")
    assert load_site(tmp_path / "bare.yaml").volume is None


IDENTITY = np.eye(4).tolist()


def test_a_rotation_typed_with_few_decimals_is_made_exact(tmp_path: Path) -> None:
    typed = [[1, 0, 0, 0.4], [0, -0.966, 0.259, -0.65], [0, -0.259, -0.966, 2.6], [0, 0, 0, 1]]
    T = load_site(write(tmp_path, arm_from_camera=typed)).T_arm_camera
    assert rotation_fault(T[:3, :3], 1e-12) is None
    assert np.abs(T - typed).max() < 1e-3


BROKEN = {
    "unknown key": ({"grizzly__openning_m": 0.3}, "did you mean opening_m"),
    "unknown section": ({"camera": 1}, "camera"),
    "no rotation": ({"arm_from_camera": (2 * np.eye(4)).tolist()}, "orthonormal"),
    "reflection": ({"arm_from_camera": np.diag([1.0, 1, -1, 1]).tolist()}, "reflection"),
    "last row": ({"arm_from_camera": [*IDENTITY[:3], [0, 0, 1, 1]]}, "last row"),
    "three rows": ({"arm_from_camera": IDENTITY[:3]}, "arm_from_camera"),
    "millimetres": (
        {"arm_from_camera": [[1, 0, 0, 400], [0, 1, 0, 0], [0, 0, 1, 2600], [0, 0, 0, 1]]},
        "millimetres",
    ),
    "not a number": ({"arm_from_camera": [[float("nan"), 0, 0, 0], *IDENTITY[1:]]}, "finite"),
    "empty box": ({"working_volume__min_m": [2, 0, 0]}, "less than"),
    "unknown frame": ({"working_volume__frame": "world"}, "'arm' or 'camera'"),
    "zero normal": ({"grizzly__plane__normal": [0, 0, 0]}, "zero"),
    "openings of slots and of a grid": (
        {"grizzly__openings_m": [0.3, 0.4]},
        "opening_m is of slots, openings_m of a grid",
    ),
    "one opening of a grid": ({"grizzly__openings_m": [0.3]}, "openings_m"),
    "openings in millimetres": (
        {"grizzly__opening_m": None, "grizzly__openings_m": [0.3, 400]},
        "grizzly.openings_m: 400.0 m is more than 3 m",
    ),
    "a bar without direction": (
        {"grizzly__bar": {"frame": "camera", "point_m": [0, 0, 3], "direction": [0, 0, 0]}},
        "grizzly.bar.direction: must not be zero",
    ),
    "a bar in millimetres": (
        {"grizzly__bar": {"frame": "camera", "point_m": [0, 0, 3000], "direction": [1, 0, 0]}},
        "grizzly.bar.point_m: [0.0, 0.0, 3000.0] m is more than 25 m",
    ),
    "a bar beside the plane": (
        {"grizzly__bar": {"frame": "arm", "point_m": [0, 0, 0.9], "direction": [1, 0, 0]}},
        "above grizzly.plane",
    ),
    "no profile": ({"grizzly__bar_profile": "square"}, "bar_profile"),
    "no opening": ({"grizzly__opening_m": 0}, "opening_m"),
    "opening in millimetres": (
        {"grizzly__opening_m": 300},
        "grizzly.opening_m: 300.0 m is more than 3 m",
    ),
    "bars in centimetres": (
        {"grizzly__bar_width_m": 7.5},
        "millimetres (centimetres) given for metres?",
    ),
    "opening in kilometres": ({"grizzly__opening_m": 0.0003}, "is it in metres?"),
    "camera in centimetres": (
        {
            "arm_from_camera": [
                [1, 0, 0, 40],
                [0, -0.966, 0.259, -65],
                [0, -0.259, -0.966, 260],
                [0, 0, 0, 1],
            ]
        },
        "arm_from_camera: [40",
    ),
    "plane in millimetres": (
        {"grizzly__plane": {"frame": "camera", "normal": [0, 0, 1], "offset_m": 2600}},
        "grizzly.plane.offset_m: 2600.0",
    ),
    "reach in millimetres": (
        {"reach": {"min_m": [-300, -300, -200], "max_m": [150, 150, 1000]}},
        "reach.min_m: [-300.0, -300.0, -200.0] m",
    ),
    "volume in centimetres": (
        {"working_volume": {"frame": "arm", "min_m": [-170, -120, 0], "max_m": [170, 120, 100]}},
        "working_volume.min_m",
    ),
    "true": ({"grizzly__opening_m": True}, "true or false"),
    "plane behind the camera": ({"grizzly__plane__offset_m": 6.0}, "behind the camera"),
    "volume behind the camera": (
        {"working_volume": {"frame": "camera", "min_m": [-1, -1, -3], "max_m": [1, 1, -1]}},
        "behind the camera",
    ),
    "volume below the plane": ({"working_volume__max_m": [1.7, 1.2, -0.1]}, "below the plane"),
    "automatic spelled otherwise": ({"grizzly__plane": "automatic"}, "plane"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_site_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    changes, word = BROKEN[fault]
    assert word in refused(write(tmp_path, **changes))


def test_the_arm_frame_needs_the_arm(tmp_path: Path) -> None:
    path = write(tmp_path, arm_from_camera=None)
    message = refused(path)
    assert "working_volume: is in the arm frame" in message
    assert "grizzly.plane: is in the arm frame" in message


def test_all_faults_are_listed_at_once(tmp_path: Path) -> None:
    message = refused(write(tmp_path, grizzly__opening_m=-1, grizzly__colour="red", reach=3))
    assert all(word in message for word in ("3 faults", "opening_m", "colour", "reach"))


def test_04_site_units(shared_data: Path) -> None:
    folder = shared_data / "reports2/04-site-units"
    assert load_site(folder / "reach_m.yaml").reach_max_m.tolist() == [0.15, 0.15, 1.0]
    for name, key in (("reach_mm", "reach.min_m: [-300"), ("arm_cm", "arm_from_camera: [14.064")):
        with pytest.raises(ConfigError) as fault:
            load_site(folder / f"{name}.yaml")
        assert key in str(fault.value)
        assert "millimetres (centimetres) given for metres?" in str(fault.value)


def lengths(value: object, way: tuple = ()) -> list[tuple]:
    """Ways to all lengths of a site document."""
    if isinstance(value, dict):
        named = [
            (key, part)
            for key, part in value.items()
            if key not in ("version", "normal", "hand_eye")
        ]
        return [found for key, part in named for found in lengths(part, (*way, key))]
    if isinstance(value, list):
        if way == ("arm_from_camera",):
            return [(*way, row, 3) for row in range(3)]
        return [found for i, part in enumerate(value) for found in lengths(part, (*way, i))]
    return [way] if isinstance(value, int | float) and value else []


def test_a_length_in_another_unit_is_an_error_or_read_as_it_stands(tmp_path: Path) -> None:
    """Of each site file one length a thousand and a hundred times: never a value that is neither
    told nor taken."""
    document = yaml.safe_load(EXAMPLE.read_text()) | {
        "reach": {"min_m": [-1.5, -1.2, 0.1], "max_m": [1.5, 1.2, 2.0]}
    }
    ways = lengths(document)
    assert len(ways) > 15
    told = 0
    for way in ways:
        for factor in (1000, 100):
            changed = yaml.safe_load(yaml.safe_dump(document))
            part = changed
            for key in way[:-1]:
                part = part[key]
            part[way[-1]] *= factor
            (tmp_path / "site.yaml").write_text(yaml.safe_dump(changed))
            try:
                load_site(tmp_path / "site.yaml")
            except ConfigError:
                told += 1
            else:
                assert factor == 100 or abs(part[way[-1]]) <= 25, way
    assert told >= 2 * len(ways) - 4
