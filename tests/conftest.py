"""Fixtures with known truth that any test file may use.

shared_data      Path of other people's recordings beside the repository; the test is skipped
                 where they are absent.
score_tool       the module that scores runs from outside, ../shared/tools/score.py; skipped where
                 it is absent.
synth_scene      a small scene (VGA, paper scale, four lumps) with exact depth, instances and
                 solids: `synth.Scene`.
synth_folder     the same scene written as a folder: left.png, right.png, calibration.yaml,
                 site.yaml, truth files.
empty_scene      the same screen without ore.
flat_plane_pair  a textured tilted plane as a rectified pair with exact disparity; free of any ray
                 caster.
"""

import importlib.util
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from stereo_ore.lab import synth
from stereo_ore.types import F32, F64, RectifiedPair, Rig

# Tests run the command that is installed beside this Python, also when its environment is not
# activated.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED.is_dir():
        pytest.skip("recordings of other people are not in ../shared/data")
    return SHARED


@pytest.fixture(scope="session")
def score_tool(shared_data: Path) -> ModuleType:
    path = shared_data.parent / "tools" / "score.py"
    if not path.is_file():
        pytest.skip("the scoring tool is not in ../shared/tools")
    spec = importlib.util.spec_from_file_location("score_tool", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def small_spec(lumps: int) -> synth.SceneSpec:
    spec = synth.sample_spec(7, "paper", "VGA")
    camera = replace(spec.camera, pitch=float(np.radians(75.0)), height=0.85)
    sensor = synth.Sensor(gain=(1.0, 1.02), full_well=3900.0)
    return replace(spec, lumps=lumps, camera=camera, sensor=sensor, supersampling=1)


@pytest.fixture(scope="session")
def synth_scene() -> synth.Scene:
    return synth.scene(small_spec(4))


@pytest.fixture(scope="session")
def synth_folder(synth_scene: synth.Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synth.write(synth_scene, tmp_path_factory.mktemp("scenes") / "paper_small")


@pytest.fixture(scope="session")
def empty_scene() -> synth.Scene:
    return synth.scene(small_spec(0))


@dataclass(frozen=True)
class PlanePair:
    """A pair that shows the plane normal·X = offset [m], with its disparity (H, W) [px] and depth
    (H, W) [m]."""

    pair: RectifiedPair
    disparity: F32
    depth: F64
    normal: F64
    offset: float


@pytest.fixture(scope="session")
def flat_plane_pair() -> PlanePair:
    rig = Rig(480, 320, 300.0, 300.0, 240.5, 159.0, 0.12)
    normal = np.array([0.15, -0.3, -0.9])
    normal /= np.linalg.norm(normal)
    offset = -1.2
    u, v = np.meshgrid(np.arange(rig.width, dtype=float), np.arange(rig.height, dtype=float))
    depth = offset / (rig.back_project(u, v, 1.0) @ normal)
    disparity = rig.disparity(depth)
    noise = np.random.default_rng(0).normal(size=(rig.height, rig.width, 3))
    texture = sum(2.0**k * cv2.GaussianBlur(noise, (0, 0), 1.2 * 2.0**k) for k in range(4))
    right = np.clip(128 + 40 * texture / texture.std(), 0, 255).astype(np.uint8)
    left = cv2.remap(
        right,
        (u - disparity).astype(np.float32),
        v.astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )
    return PlanePair(
        RectifiedPair(left, right, rig), disparity.astype(np.float32), depth, normal, offset
    )
