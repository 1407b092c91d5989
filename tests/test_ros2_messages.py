"""What topics of ROS 2 say, and what is said where there is no ROS 2: without ROS 2."""

import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from live import ListSink, make_message, make_record
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import CalibrationError, ConfigError, FrameError, MissingExtraError
from stereo_ore.io.calibration import load
from stereo_ore.io.ros_frame import RosFrame, quaternion
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.ros2 import install, markers, sink
from stereo_ore.plant.ros2.diagnosis import diagnostics
from stereo_ore.plant.ros2.infos import Infos
from stereo_ore.plant.ros2.view import View, static_publisher
from stereo_ore.plant.sinks.settings import load_sinks, with_ros2
from stereo_ore.stages.rectify import make_rectifier

REPOSITORY = Path(__file__).parents[1]
CALIBRATION = REPOSITORY / "data" / "paper_03" / "calibration.yaml"
STAMP = 1_790_000_000_123_456_789


class Types(defaultdict[str, Callable[..., Any]]):
    """Messages that hold what they are given."""

    def __missing__(self, name: str) -> Callable[..., Any]:
        return SimpleNamespace


def ros() -> RosFrame:
    return RosFrame(Types(), STAMP, ("left_optical", "base"))


def test_targets_are_in_the_frame_asked_for_and_best_first() -> None:
    record = make_record(index=3, ores=3)
    message = ros().targets(record, "arm", [3, 1])
    assert (message.header.frame_id, message.header.stamp.sec) == ("base", STAMP // 10**9)
    assert [pose.position.y for pose in message.poses] == [3.0, 1.0]
    assert ros().targets(record, "camera", [2]).header.frame_id == "left_optical"
    assert ros().targets({"ores": []}, "arm", []).poses == []


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(deadline=None)
def test_quaternions_are_scipys(seed: int, half_turn: bool) -> None:
    vector = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(
        np.pi * vector / np.linalg.norm(vector) if half_turn else vector
    )
    found = np.array(quaternion(rotation.as_matrix()))
    expected = rotation.as_quat()
    np.testing.assert_allclose(abs(found @ expected), 1.0, atol=1e-12)
    assert found[3] >= 0


def test_a_screen_seen_edge_on_or_not_at_all_is_not_drawn() -> None:
    rig = make_rectifier(load(CALIBRATION)).rig
    plane = {"normal": [0.0, 0.0, -1.0], "offset_m": -2.0}
    corners = markers.screen_corners({"grizzly": plane}, rig)
    assert corners is not None
    np.testing.assert_allclose(corners[:, 2], 2.0)
    edge_on = {"normal": [0.0, -1.0, 0.0], "offset_m": -1.0}
    for grizzly in (None, edge_on, {"normal": None, "offset_m": None}):
        assert markers.screen_corners({"grizzly": grizzly}, rig) is None


def test_a_lump_without_a_solid_has_no_marker_and_no_lifetime_is_endless() -> None:
    rig = make_rectifier(load(CALIBRATION)).rig
    record = make_record(ores=2)
    record["ores"][0] |= {"box": None, "size_m": None}
    found = markers.lump_markers(ros(), record, rig, 0.0).markers
    assert [marker.id for marker in found[1:]] == [2, 2]
    assert all(marker.lifetime.nanosec == 1 for marker in found[1:])
    assert found[2].text == "2\n0.00 × 0.30 × 0.20 m"


@pytest.mark.parametrize(
    ("status", "level"),
    [("ok", b"\x00"), ("degraded", b"\x01"), ("failed", b"\x02"), ("expired", b"\x01")],
)
def test_diagnostics_have_status_reasons_and_latency(status: str, level: bytes) -> None:
    message = replace(make_message(status="ok"), status=status, reasons=("ONE", "TWO"))
    (found,) = diagnostics(ros(), message, "stereo_ore: targets", "ZED", 0.5).status
    values = {pair.key: pair.value for pair in found.values}
    assert (found.level, found.hardware_id) == (level, "ZED")
    assert (values["status"], values["reasons"], values["latency_ms"]) == (
        status,
        "ONE TWO",
        "500.0",
    )
    assert found.message == f"{status} (ONE TWO), 2 targets"


def test_a_frame_is_shown_to_sinks_that_can_and_published_to_the_others() -> None:
    class Showing(ListSink):
        def __init__(self) -> None:
            super().__init__()
            self.shown: list[Any] = []

        def show(self, message: Any, record: Any, age_s: float) -> None:
            self.shown.append((message, record, age_s))

        def show_files(self, record: Any) -> None:
            self.shown.append(record)

    plain, showing = ListSink(), Showing()
    record = make_record()
    with Publisher([plain, showing], valid_for_s=5.0) as publisher:
        made = publisher.publish(record, age_s=0.25)
        publisher.show_files(record)
    assert showing.shown == [(made, record, 0.25), record]
    assert [message.status for _, message in showing.messages] == ["stopped"]
    assert [message.status for _, message in plain.messages] == ["ok", "stopped"]


def test_the_command_for_a_static_transform_is_the_sites(tmp_path: Path) -> None:
    rig = make_rectifier(load(CALIBRATION)).rig
    turned = np.array([[0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]], float)
    view = View(tmp_path, rig, turned, "ZED", 5.0, "left_optical")
    words = (static_publisher(view, "base") or "").split()
    given = {key: value for key, value in pairwise(words) if key.startswith("--")}
    assert (float(given["--x"]), float(given["--y"]), float(given["--z"])) == (1.5, -2, 3)
    assert float(given["--qz"]) == pytest.approx(np.sqrt(0.5))
    assert float(given["--qw"]) == pytest.approx(np.sqrt(0.5))
    assert (given["--frame-id"], given["--child-frame-id"]) == ("base", "left_optical")
    assert static_publisher(replace(view, T_arm_camera=None), "base") is None


def published() -> set[str]:
    return {name if name.startswith("/") else f"/stereo_ore/{name}" for name in sink.TOPICS}


def test_the_layouts_for_viewers_show_topics_that_there_are() -> None:
    rviz = yaml.safe_load((REPOSITORY / "docs" / "ros2" / "stereo_ore.rviz").read_text())
    displays = rviz["Visualization Manager"]["Displays"]
    shown = {display["Class"].partition("/")[2]: display for display in displays}
    assert {"PointCloud2", "MarkerArray", "PoseArray", "Image"} <= shown.keys()
    topics = [display["Topic"] for display in displays if "Topic" in display]
    assert {topic["Value"] for topic in topics} <= published()
    assert {topic["Durability Policy"] for topic in topics} == {"Transient Local"}
    text = (REPOSITORY / "docs" / "ros2" / "foxglove.json").read_text(encoding="utf-8")
    panels = json.loads(text)["configById"]
    assert set(re.findall(r'"(/[a-z_/]+)"', text)) <= published()
    assert set(re.findall(r'"(?:first|second)": "([^"]+)"', text)) == set(panels)


def test_the_page_lists_every_topic_with_its_type() -> None:
    page = (REPOSITORY / "docs" / "ros2.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([^`]+)` \| (\w+) \|", page, re.MULTILINE))
    kinds = {name: kind.rpartition("/")[2] for name, kind in sink.TOPICS.items()}
    assert rows == {**kinds, sink.STATIC: "TFMessage"}


# --- calibrations of topics

TOPICS = ("/camera/left/image_rect", "/camera/right/image_rect")


def info(eye: int, scale: float = 1.0, stamp: int = 0, shift: float = 0.0) -> Any:
    calibration = load(CALIBRATION)
    camera = (calibration.left, calibration.right)[eye]
    P = np.column_stack([camera.K, np.zeros(3)])
    P[:2, 2] += shift
    P[0, 3] = eye * scale * camera.focal_px[0] * calibration.t_right_left[0]
    width, height = calibration.image_size
    time = SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=time),
        width=width,
        height=height,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=P.ravel(),
    )


def infos(**changes: Any) -> Infos:
    found = Infos(TOPICS)
    for eye in (0, 1):
        found.add(eye, info(eye, **changes))
    return found


def test_a_driver_that_was_never_calibrated_has_no_info() -> None:
    found = Infos(TOPICS)
    for eye in (0, 1):
        empty = info(eye)
        empty.k = np.zeros(9)
        found.add(eye, empty)
    assert not found.complete


def test_the_calibration_of_topics_is_that_of_the_file() -> None:
    used, file = infos().use(), load(CALIBRATION)
    assert used.image_size == file.image_size
    np.testing.assert_allclose(used.t_right_left, file.t_right_left)
    assert used.left.focal_px == file.left.focal_px


def test_another_calibration_on_the_way_is_a_failed_frame() -> None:
    found = infos()
    found.check((5, 5))
    found.use()
    found.add(1, info(1, scale=1.01, stamp=7))
    with pytest.raises(FrameError, match="camera_info is another one") as caught:
        found.check((7, 7))
    assert caught.value.code == "CALIBRATION_CHANGED"
    # The frame whose own camera_info is the old one is still right.
    found.add(1, info(1, stamp=8))
    found.check((8, 8))


def test_a_given_calibration_is_compared_with_the_topics() -> None:
    file = load(CALIBRATION)
    assert infos().compare(file) is None
    assert "+2.0 %" in (infos(scale=1.02).compare(file) or "")
    assert "3.0 px" in (infos(shift=3.0).compare(file) or "")
    assert "can't be used" in (infos(scale=0.0).compare(file) or "")
    other = infos()
    for eye in (0, 1):
        small = info(eye)
        small.width = 1300
        other.add(eye, small)
    assert "is for images of" in (other.compare(file) or "")


def test_a_camera_info_without_a_baseline_asks_for_a_calibration() -> None:
    with pytest.raises(CalibrationError, match="--calib"):
        infos(scale=0.0).use()


# --- without ROS 2


def invoke(*arguments: object) -> Any:
    load_verbs()
    return CliRunner().invoke(app, [*map(str, arguments)])


@pytest.fixture
def without_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    find = install.importlib.util.find_spec

    def none_of_ros(name: str) -> Any:
        return None if name == "rclpy" else find(name)

    monkeypatch.setattr(install.importlib.util, "find_spec", none_of_ros)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


@pytest.mark.usefixtures("without_rclpy")
def test_what_is_missing_is_one_line_with_extra_platform_and_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    done = invoke("serve", "--ros2", "--out", tmp_path / "out")
    assert isinstance(done.exception, MissingExtraError)
    assert python in str(done.exception)
    monkeypatch.setattr(install.sys, "platform", "linux")
    monkeypatch.setattr(install.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(install.sys, "version_info", (3, 12, 1, "final", 0))
    monkeypatch.setattr(install, "_here", lambda: "Linux x86_64, Python 3.12")
    with pytest.raises(
        MissingExtraError, match=r'rclpy is not installed\. pip install "stereo-ore\[ros2\]"'
    ):
        install.require()
    monkeypatch.setattr(install.platform, "machine", lambda: "aarch64")
    with pytest.raises(
        MissingExtraError, match=r"is for Linux x86_64 and Python 3\.11 to 3\.13, this is"
    ):
        install.require()


@pytest.mark.usefixtures("without_rclpy")
def test_a_replay_without_ros_2_says_so(tmp_path: Path) -> None:
    done = invoke("replay", REPOSITORY / "data", "--ros2-out")
    assert isinstance(done.exception, MissingExtraError)


def test_one_topic_of_two_and_two_sources_are_wrong_usage(tmp_path: Path) -> None:
    done = invoke("serve", "--ros2", "--left-topic", "/l", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "both --left-topic and --right-topic" in done.output
    done = invoke("serve", tmp_path, "--ros2", "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "one of SOURCE" in done.output


def test_nothing_but_ros_2_loads_ros_2(tmp_path: Path) -> None:
    """The verbs, a publisher with a sink and every module for ROS 2."""
    code = (
        "import sys; from stereo_ore import cli; cli.load_verbs();"
        "import stereo_ore.plant.ros2.sink, stereo_ore.plant.ros2.opening, stereo_ore.cli.serve;"
        "from stereo_ore.plant.sinks.settings import load_sinks, open_sinks;"
        "open_sinks(load_sinks(None, tcp=0));"
        "print([name for name in sys.modules if name.split('.')[0] in"
        " ('rclpy', 'sensor_msgs', 'rosidl_parser')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    code = (
        "import sys; from stereo_ore import cli; cli.load_verbs();"
        "print([name for name in sys.modules if 'plant' in name])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_sinks_file_names_the_frames(tmp_path: Path) -> None:
    assert load_sinks(None).ros2 is None
    wanted = with_ros2(load_sinks(None)).ros2
    assert wanted is not None
    assert (wanted.namespace, wanted.arm_frame) == ("stereo_ore", "arm_base_link")
    file = tmp_path / "sinks.yaml"
    head = "format: stereo_ore/sinks\nversion: 1\n"
    file.write_text(f"{head}ros2: {{namespace: /plant/north, arm_frame: base}}\n")
    for found in (load_sinks(file).ros2, with_ros2(load_sinks(file)).ros2):
        assert found is not None
        assert (found.namespace, found.arm_frame) == ("/plant/north", "base")
    for wrong in ("namespace: a b", "arm_frame: ''", "namespace: //a", "frame: base"):
        file.write_text(f"{head}ros2: {{{wrong}}}\n")
        with pytest.raises(ConfigError, match="ros2"):
            load_sinks(file)


# --- a sourced ROS 2


def sourced(folder: Path, monkeypatch: pytest.MonkeyPatch, paths: list[Path]) -> Path:
    """A ROS 2 installation in `folder`, sourced: a package that is found first, and its
    libraries among `paths`."""
    place = folder / "lib" / "python3" / "site-packages"
    (place / "rclpy").mkdir(parents=True)
    (place / "rclpy" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(place))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(folder))
    monkeypatch.setenv("LD_LIBRARY_PATH", os.pathsep.join(map(str, paths)))
    return folder


def test_a_sourced_ros_2_gets_its_own_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheels, own = Path(sys.prefix) / "lib", tmp_path / "ros" / "lib"
    packages = wheels / "python3" / "site-packages"
    opencv = f"{packages}/cv2/../../lib64"
    paths = [wheels, packages / "ros_rcl.libs", own, Path(opencv)]
    sourced(tmp_path / "ros", monkeypatch, paths)
    found = install.cleaned_environment()
    assert found is not None
    assert found["LD_LIBRARY_PATH"] == f"{own}{os.pathsep}{opencv}"
    assert found[install.BOOTSTRAPPED] == "1"
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{own}{os.pathsep}{opencv}")
    assert install.cleaned_environment() is None
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(wheels))
    assert install.cleaned_environment() is None
