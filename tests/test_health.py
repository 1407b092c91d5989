"""The self-checks on made-up surfaces, pairs and lines whose fault is known."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from screens import DISTANCE, Screen, draw
from test_tracks import lump

from stereo_ore.config import Config, GrizzlyConfig, HealthConfig
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.history import Watch
from stereo_ore.stages.health import eye_doubts, rows, screen_doubts
from stereo_ore.types import Disparity, Plane, RectifiedPair, Region, Registration

CONFIG, GRIZZLY = HealthConfig(), GrizzlyConfig()
WIDE = Screen(half=5.0, noise_px=0.15, pit=0.5)
SIGMA_M = DISTANCE**2 / (300 * 0.12) * 0.15


def told(screen: Screen, plane: Plane, depth: float = 0.3) -> bool:
    """Whether the screen is told to have moved, with `depth` of what lies beneath it in the working
    volume."""
    surface, _ = draw(screen)
    surface.xyz[screen.plane.height(surface.xyz) < -depth] = np.nan
    return [reason.code for reason in screen_doubts(surface, plane, GRIZZLY, CONFIG)] == [
        "SCREEN_MOVED"
    ]


def turned(plane: Plane, angle: float) -> Plane:
    """About the x axis through the middle of the screen."""
    c, s = np.cos(angle), np.sin(angle)
    normal = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ plane.normal
    return Plane(normal, float(normal @ [0, 0, DISTANCE]))


@given(
    st.floats(-0.3, 0.3), st.floats(0, np.pi), st.integers(0, 1000), st.sampled_from([0.25, 0.5])
)
@settings(max_examples=15, deadline=None)
def test_a_screen_at_its_place_is_not_told(tilt: float, yaw: float, seed: int, pit: float) -> None:
    screen = replace(WIDE, tilt=tilt, yaw=yaw, seed=seed, pit=pit)
    assert not told(screen, screen.plane)


@given(st.floats(-0.3, 0.3), st.sampled_from([-25.0, -8.0, 8.0, 25.0]), st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_a_screen_elsewhere_is_told(tilt: float, sigmas: float, seed: int) -> None:
    screen = replace(WIDE, tilt=tilt, seed=seed, pit=5.0)
    assert told(screen, Plane(screen.plane.normal, screen.plane.offset + sigmas * SIGMA_M))


@pytest.mark.parametrize("angle_deg", [-8, -3, 3, 8])
def test_a_screen_that_is_turned_is_told(angle_deg: float) -> None:
    screen = replace(WIDE, pit=5.0)
    assert told(screen, turned(screen.plane, np.radians(angle_deg)))


def test_little_of_an_offset_and_a_tilt_is_told_together_only() -> None:
    screen = replace(WIDE, pit=5.0)
    low = Plane(screen.plane.normal, screen.plane.offset + 3.2 * SIGMA_M)
    steep = turned(screen.plane, 0.02)
    assert not told(screen, low)
    assert not told(screen, steep)
    assert told(screen, Plane(steep.normal, steep.offset + 3.2 * SIGMA_M))


def test_tips_of_ore_alone_are_told() -> None:
    """What is left in the working volume of a scene that seems to lie lower than it does."""
    lumps = tuple((s, c, 0.1, 0.25) for s in (-0.8, 0.0, 0.8) for c in (-0.6, 0.0, 0.6))
    screen = replace(WIDE, lumps=lumps)
    assert told(screen, Plane(screen.plane.normal, screen.plane.offset + 0.2), depth=-0.05)


def test_a_wide_floor_of_the_pit_is_no_moved_screen() -> None:
    screen = Screen(half=0.42, floor=0.3, noise_px=0.15)
    assert not told(screen, screen.plane, depth=1.0)


def test_a_screen_that_is_not_seen_is_not_judged() -> None:
    """Spheres of ore side by side hide all bars."""
    ore = tuple(
        (s, c, 0.1, 0.16) for s in np.arange(-1.2, 1.3, 0.15) for c in np.arange(-0.9, 1.0, 0.15)
    )
    screen = replace(WIDE, lumps=ore)
    assert not told(screen, screen.plane)


def pair_of(
    flat: Any, turn: tuple[float, float, float] = (1, 0, 0)
) -> tuple[RectifiedPair, Disparity]:
    """The pair with the right eye's rows scaled, sheared and shifted: v' = a·v + b·(u − middle) +
    c."""
    height, width = flat.disparity.shape
    a, b, c = turn
    matrix = np.array([[1, 0, 0], [b, a, c + (1 - a) * height / 2 - b * width / 2]], float)
    right = cv2.warpAffine(
        flat.pair.right,
        matrix,
        (width, height),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )
    pair = replace(flat.pair, right=right)
    values = flat.disparity.copy()
    cues = {"spread_px": np.zeros_like(values)}
    return pair, Disparity(values, Region(0, 0, width, height, 0, 64), np.ones_like(values), cues)


def rows_of(pair: RectifiedPair, disparity: Disparity) -> float:
    left, right = (
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8)
        for image in (pair.left, pair.right)
    )
    return rows.row_shift(left, right, disparity, pair.rig.disparity_offset_px).systematic


def codes(pair: RectifiedPair, disparity: Disparity) -> list[str]:
    return [reason.code for reason in eye_doubts(pair, disparity, CONFIG)]


def test_aligned_rows_are_not_told(flat_plane_pair: Any) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    assert rows_of(pair, disparity) < 0.01
    assert codes(pair, disparity) == []


def test_grain_is_no_disagreement_where_bars_were_measured(flat_plane_pair: Any) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    bars = Registration(np.zeros(3), 0.0, 0.0, 0.0, 0.0, 0.1)
    least = CONFIG.min_right_share
    for share, told in (
        (least + 0.02, (False, False)),
        (least - 0.02, (True, False)),
        (least / 2, (True, True)),
    ):
        grainy = replace(
            disparity, confidence=np.full_like(disparity.values, share), diagnostics={}
        )
        found = [
            [reason.code for reason in eye_doubts(pair, grainy, CONFIG, known)]
            for known in (None, bars)
        ]
        assert tuple("EYES_DISAGREE" in codes for codes in found) == told


def test_a_part_whose_rows_differ_is_told(flat_plane_pair: Any) -> None:
    """As under a drop: the middle of one eye is magnified."""
    pair, disparity = pair_of(flat_plane_pair)
    v, u = np.indices(disparity.values.shape).astype(np.float32)
    middle = 1 - ((u - 240) ** 2 + (v - 160) ** 2) / 100**2
    dv = np.float32(0.06) * (v - 160) * np.clip(middle, 0, 1)
    right = cv2.remap(pair.right, u, v - dv, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    assert "PARTS_DISAGREE" in codes(replace(pair, right=np.asarray(right, np.uint8)), disparity)


@pytest.mark.parametrize("shift_px", [-8, -6, -3, -2, -1, -0.5, 0.1, 0.25, 1, 2, 4, 7])
def test_a_row_shift_is_measured_and_told(flat_plane_pair: Any, shift_px: float) -> None:
    pair, disparity = pair_of(flat_plane_pair, (1, 0, shift_px))
    assert 0.9 < rows_of(pair, disparity) / abs(shift_px) < 1.5
    assert "ROWS_DISAGREE" in codes(pair, disparity)


@pytest.mark.parametrize(("scale", "shear"), [(1.002, 0), (1, 0.001), (1, -0.003), (1.001, 0.001)])
def test_a_turned_or_scaled_eye_is_measured_and_told(
    flat_plane_pair: Any, scale: float, shear: float
) -> None:
    """Their mean row difference is zero."""
    pair, disparity = pair_of(flat_plane_pair, (scale, shear, 0))
    height, width = disparity.values.shape
    rms = np.hypot((scale - 1) * height, shear * width) / np.sqrt(12)
    assert 0.9 < rows_of(pair, disparity) / rms < 1.5
    assert "ROWS_DISAGREE" in codes(pair, disparity)


def test_noise_is_no_row_shift(flat_plane_pair: Any) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    noise = np.random.default_rng(1).normal(0, 12, (2, *pair.left.shape))
    left, right = (
        np.clip(eye + n, 0, 255).astype(np.uint8)
        for eye, n in zip((pair.left, pair.right), noise, strict=True)
    )
    assert rows_of(replace(pair, left=left, right=right), disparity) < 0.02


@pytest.mark.parametrize("size", [(2, 2), (9, 400), (300, 7), (16, 16), (40, 40)])
def test_rows_of_little_are_unknown(flat_plane_pair: Any, size: tuple[int, int]) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    region = Region(80, 0, 80 + size[1], size[0], 0, 64)
    assert rows_of(pair, Disparity(disparity.values, region, disparity.confidence, {})) == 0


def test_a_correction_of_the_calibration_moves_no_pixel(flat_plane_pair: Any) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    corrected = replace(pair, rig=replace(pair.rig, disparity_offset_px=7.0))
    shifted = replace(disparity, values=disparity.values + np.float32(7.0))
    assert rows_of(corrected, shifted) == pytest.approx(rows_of(pair, disparity), abs=1e-3)


def test_the_dark_is_told(flat_plane_pair: Any) -> None:
    pair, disparity = pair_of(flat_plane_pair)
    dark = replace(pair, left=pair.left // 20, right=pair.right // 20)
    assert "TOO_DARK" in codes(dark, disparity)


def line(
    index: int, valid: int = 800, status: str = "ok", images: list[str] | None = None
) -> FrameLines:
    counts = {"pixels": 1000, "disparities": valid, "targets": int(status == "ok")}
    record = {
        "frame": str(index),
        "status": status,
        "reasons": [],
        "counts": counts,
        "ores": [{"id": 1} | lump((0.0, 0.0, 2.0))],
        "targets": [1] if status == "ok" else [],
        "withheld": [],
        "grizzly": {"normal": [0.0, 0.0, -1.0], "openings_m": None},
        "tracks": {"started": [], "ended": []},
    }
    inputs = {
        "frame": str(index),
        "images": images or [f"l{index}", f"r{index}"] if status != "failed" else None,
    }
    return FrameLines(json.dumps(record), "{}", json.dumps(inputs))


def watching(earlier: Sequence[FrameLines] = (), **changes: object) -> Watch:
    return Watch(Config(health=HealthConfig(**changes)), earlier=earlier)


def judged(lines: list[FrameLines], watch: Watch | None = None) -> list[list[str]]:
    watch = watch or watching()
    records = [json.loads(watch.judge(entry).record) for entry in lines]
    assert all(not (record["reasons"] and record["targets"]) for record in records)
    return [[reason["code"] for reason in record["reasons"]] for record in records]


def test_a_frozen_eye_is_told_also_after_a_frame_that_failed() -> None:
    frames = [
        line(0),
        line(1, status="failed"),
        line(2, images=["l0", "new"]),
        line(3),
        line(4, images=["x", "r3"]),
    ]
    assert judged(frames) == [[], [], ["FRAME_FROZEN"], [], ["FRAME_FROZEN"]]
    assert judged(frames, watching(refuse_frozen=False)) == [[]] * 5


def test_a_ring_buffer_that_repeats_itself_is_told() -> None:
    ring = [line(i, images=[f"l{i % 3}", f"r{i % 3}"]) for i in range(7)]
    assert judged(ring) == [[]] * 3 + [["FRAME_FROZEN"]] * 4
    assert judged(ring, watching(frozen_history=2)) == [[]] * 7
    far = [line(i) for i in range(CONFIG.frozen_history)]
    assert judged([*far, line(64, images=["l0", "new"])])[-1] == ["FRAME_FROZEN"]


def test_fewer_disparities_than_usual_are_told_for_as_long_as_they_last() -> None:
    usual, few = [line(i) for i in range(5)], [line(i, valid=450) for i in range(5, 40)]
    assert judged([*usual, *few]) == [[]] * 5 + [["VALID_SHARE_FELL"]] * 35
    assert judged([*usual[:4], few[0]]) == [[]] * 5


def test_a_slow_change_is_not_told() -> None:
    assert judged([line(i, valid=900 - 5 * i) for i in range(120)]) == [[]] * 120


def registered(index: int, offset_m: float, sigma_m: float = 0.002) -> FrameLines:
    """A frame whose bars were measured so far from their place."""
    lines = line(index)
    record = json.loads(lines.record)
    moved = {"offset_m": offset_m, "worst_m": abs(offset_m) + 0.004, "sigma_m": sigma_m}
    record["grizzly"] |= {"registration": moved, "openings_m": [0.3]}
    return replace(lines, record=json.dumps(record))


def drifting(offsets_m: Sequence[float], **other: float) -> list[int]:
    """Frames that say SCREEN_DRIFTS; they keep their targets."""
    watch = watching()
    frames = [registered(index, offset, **other) for index, offset in enumerate(offsets_m)]
    records = [json.loads(watch.judge(frame).record) for frame in frames]
    assert all(record["status"] == "ok" for record in records)
    codes = [[reason["code"] for reason in record["reasons"]] for record in records]
    return [index for index, told in enumerate(codes) if told == ["SCREEN_DRIFTS"]]


def test_bars_that_are_registered_ever_farther_from_where_they_were_are_told() -> None:
    slow = [0.0002 * index for index in range(120)]
    told = drifting(slow)
    assert told
    assert told == list(range(told[0], 120))
    assert 0.012 < slow[told[0]] < 0.02
    assert drifting(slow, sigma_m=0.02) == []
    assert drifting([0.02 + 0.003 * (index % 3) for index in range(120)]) == []


FRAMES = st.lists(
    st.tuples(
        st.sampled_from([900, 500, 100]),
        st.sampled_from(["ok", "empty", "failed"]),
        st.integers(0, 2),
    )
)


@given(FRAMES, st.integers(0, 30))
@settings(deadline=None)
def test_a_continued_watch_judges_as_one_that_never_stopped(
    frames: list[tuple[int, str, int]], stop: int
) -> None:
    lines = [
        line(i, valid, status, [f"l{image}", f"r{i}"])
        for i, (valid, status, image) in enumerate(frames)
    ]
    watch = watching()
    whole = [watch.judge(entry) for entry in lines]
    later = watching(whole[:stop])
    assert [later.judge(entry) for entry in lines[stop:]] == whole[stop:]
