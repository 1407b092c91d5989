import sys
from dataclasses import replace

import numpy as np
import pytest
from analytic import Ellipsoid, View, look_down

from stereo_ore.config.models import SolidConfig, StrikeConfig
from stereo_ore.draw.scene_picture import draw_scene
from stereo_ore.errors import MissingExtraError
from stereo_ore.stages.solid import solids
from stereo_ore.stages.strike import plans
from stereo_ore.types import FrameResult, Ore, Site

pytest.importorskip("matplotlib")


def frame(view: View) -> FrameResult:
    found = solids(view.surface, view.ore_map, view.grizzly, SolidConfig())
    struck = plans(view.surface, view.ore_map, found, view.grizzly, Site(), StrikeConfig())
    ores = tuple(
        Ore(i, 100, 100, False, np.zeros(3), solid, plan)
        for i, (solid, plan) in enumerate(zip(found, struck, strict=True), 1)
    )
    return FrameResult(
        "000001", 0, None, "ok", (), {}, view.grizzly, ores, (1,), surface=view.surface
    )


@pytest.fixture(scope="module")
def result() -> FrameResult:
    return frame(look_down([Ellipsoid((0.1, 0.08, 0.06), (0.0, 0.0, 0.06))], bars=True))


def test_solids_and_strikes_are_drawn(result: FrameResult) -> None:
    image = draw_scene(result)
    assert image is not None
    assert image.shape == (750, 1000, 3)
    assert image.dtype == np.uint8
    blue, green, red = (image[..., k].astype(int) for k in range(3))
    assert ((red - green > 30) & (red - blue > 30)).sum() > 3000  # the oversize solid
    assert ((blue - red > 90) & (blue - green > 60)).sum() > 30  # the first target's arrow


def test_colours_tell_size(result: FrameResult) -> None:
    solid = result.ores[0].solid
    assert solid is not None
    passes = replace(result, ores=(replace(result.ores[0], solid=replace(solid, oversize=False)),))
    image = draw_scene(passes)
    assert image is not None
    assert (image[..., 1].astype(int) - image[..., 2] > 20).sum() > 3000


def test_equal_frames_give_equal_pictures(result: FrameResult) -> None:
    one, other = draw_scene(result), draw_scene(result)
    assert one is not None
    assert other is not None
    assert one.tobytes() == other.tobytes()


def test_frames_that_stopped_early(result: FrameResult) -> None:
    assert draw_scene(replace(result, grizzly=None)) is None
    bare = draw_scene(replace(result, ores=(), surface=None))
    assert bare is not None
    assert bare.std() > 0
    without = replace(result, ores=(replace(result.ores[0], solid=None),))
    assert draw_scene(without) is not None


def test_without_matplotlib_one_line_says_what_to_install(
    result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match="matplotlib"):
        draw_scene(result)
