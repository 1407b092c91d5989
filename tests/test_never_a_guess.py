"""Counts over many scenes: no target without a site that fits, no ore on steel, none on a body over
the screen. ``python -m pytest -s -m slow tests/test_never_a_guess.py`` prints them."""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.chain import Chain
from stereo_ore.io import calibration
from stereo_ore.lab import synth
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.types import (
    U8,
    CameraModel,
    FrameResult,
    Plane,
    Site,
    StereoCalibration,
    StereoPair,
    Volume,
)

pytestmark = pytest.mark.slow

WRONG = Site(
    np.eye(4),
    Volume(np.eye(4), np.array([-3.0, -3, 0.3]), np.array([3.0, 3, 6])),
    Plane(np.array([0.0, -0.5, -np.sqrt(0.75)]), -1.5),
    0.3,
    0.08,
)
"""Whole, and of another place."""
EMPTY, BODIES = range(3000, 3040), range(3100, 3160)
KINDS = ("hammer", "chain", "post")
WITHHELD = {"NO_ARM_FRAME", "NO_VOLUME_GIVEN", "NO_PLANE_GIVEN"}


def spec(seed: int, family: str, **changes: object) -> synth.SceneSpec:
    return replace(synth.sample_spec(seed, family, "VGA"), supersampling=1, **changes)


def show(text: str) -> None:
    sys.stdout.write(text + "\n")


def told(result: FrameResult) -> str:
    return " ".join([result.status, *sorted({reason.code for reason in result.reasons})])


def test_an_empty_screen_gives_no_target_without_a_site_with_half_and_with_a_wrong_one() -> None:
    statuses: dict[str, Counter[str]] = {"none": Counter(), "half": Counter(), "wrong": Counter()}
    ores: Counter[str] = Counter()
    for seed in EMPTY:
        scene = synth.scene(spec(seed, "empty"))
        half = Site(scene.site.T_arm_camera, opening_m=scene.site.opening_m)
        for name, site in (("none", Site()), ("half", half), ("wrong", WRONG)):
            result = Chain(scene.calibration, site)(scene.pair)
            statuses[name][told(result)] += 1
            ores[name] += len(result.ores)
            assert result.targets == (), (seed, name)
            assert name == "wrong" or set(result.withheld) <= WITHHELD
    show(f"\nempty screens: ores {dict(ores)}")
    for name, counts in statuses.items():
        show(f"{name}: {dict(counts)}")
    assert ores["none"] + ores["half"] == 0


def photographs(folder: Path) -> Iterator[tuple[str, StereoCalibration, U8, U8]]:
    """Pairs without a screen: rooms, toys, bicycles, plants, boards."""
    for place in sorted((folder / "stereo_gt" / "middlebury_v3_quarter").iterdir()):
        yield (
            place.name,
            calibration.load(place / "calib.txt"),
            *(cv2.imread(str(place / f"im{eye}.png")) for eye in (0, 1)),
        )
    given = json.loads((folder / "oakd" / "stereodemo_calibration.json").read_text())
    eye = CameraModel((given["fx"], given["fy"]), (given["cx0"], given["cy"]))
    oakd = StereoCalibration((640, 480), eye, eye, np.eye(3), np.array([-0.075, 0, 0]))
    eye = CameraModel((533.0, 533.0), (335.0, 240.0))
    boards = StereoCalibration((640, 480), eye, eye, np.eye(3), np.array([-0.083, 0, 0]))
    for left in sorted((folder / "oakd").glob("*_left.png")):
        right = left.with_name(left.name.replace("left", "right"))
        yield left.stem, oakd, cv2.imread(str(left)), cv2.imread(str(right))
    for left in sorted((folder / "boards" / "opencv").glob("left*.jpg")):
        right = left.with_name(left.name.replace("left", "right"))
        yield left.stem, boards, cv2.imread(str(left)), cv2.imread(str(right))
    zed = json.loads((folder / "zed_pair" / "zed_camera_param.json").read_text())
    eye = CameraModel((zed["fx"], zed["fy"]), (zed["cx"], zed["cy"]))
    one = StereoCalibration((1920, 1080), eye, eye, np.eye(3), np.array([-0.12, 0, 0]))
    yield (
        "zed",
        one,
        *(cv2.imread(str(folder / "zed_pair" / f"{eye}.png")) for eye in ("left", "right")),
    )


def test_a_photograph_without_a_screen_gives_no_target(shared_data: Path) -> None:
    statuses: Counter[str] = Counter()
    made_up = 0
    for name, camera, left, right in photographs(shared_data):
        for site in (Site(), WRONG):
            result = Chain(camera, site)(StereoPair(left, right, name=name))
            statuses[("none " if site is not WRONG else "wrong ") + told(result)] += 1
            # With a whole site that somebody has made up, what shows no bars can't be told from a
            # screen full of ore: counted, not judged.
            assert site is WRONG or result.targets == (), (name, told(result))
            made_up += bool(result.targets)
    show(f"\nphotographs: {dict(statuses)}; with a made-up site {made_up} have targets")
    assert sum(statuses.values()) == 2 * 24


def test_nothing_on_a_body_over_the_screen_is_an_ore() -> None:
    on_body: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for seed in BODIES:
        kind = KINDS[seed % 3]
        scene = synth.scene(spec(seed, "large", foreign=(kind,)))
        result = Chain(scene.calibration, scene.site)(scene.pair)
        found[told(result)] += 1
        if result.ore_map is None:
            continue
        tool = scene.instance == TOOL
        for ore in result.ores:
            mine = result.ore_map.labels == ore.id
            if (mine & tool).sum() > 0.5 * mine.sum():
                on_body[f"{kind} ores"] += 1
                on_body[f"{kind} targets"] += ore.id in result.targets
                show(f"{seed} {kind}: ore {ore.id}, {mine.sum()} px")
        for ore in result.ores:
            if ore.id in result.targets and ore.strike is not None:
                u, v = np.rint(result.pair.rig.project(ore.strike.point)).astype(int)  # type: ignore[union-attr]
                on_body[f"{kind} strikes"] += bool(tool[v, u])
    show(f"\nbodies: {dict(on_body)}; {dict(found)}")
    assert sum(count for name, count in on_body.items() if not name.endswith("ores")) == 0
