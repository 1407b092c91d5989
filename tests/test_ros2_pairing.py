"""Images of two topics become frames: pure logic, without ROS 2."""

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.plant.ros2.pairing import (
    ROS_MOST_WAITING,
    ROS_PATIENCE_S,
    Coming,
    Newest,
    Pairer,
    TakenEyes,
)

MS = 1_000_000
SKEW = 5 * MS
PERIOD = 66 * MS
START = 1_790_000_000_000_000_000

Arrivals = Iterable[tuple[int, int, int]]
"""Eye, number of the frame, its stamp [ns]."""


def frames_of(arrivals: Arrivals, numbered: bool = True) -> list[Coming]:
    pairer, found = Pairer(SKEW), []
    for place, (eye, number, stamp) in enumerate(arrivals):
        image = TakenEyes(stamp, float(place), number, number + 1 if numbered else None)
        found += pairer.add(eye, image)
    return found + pairer.overdue(1e9)


def in_turns(
    count: int, left: set[int] = frozenset(), right: set[int] = frozenset()
) -> list[tuple[int, int, int]]:
    """Both eyes in turns; those in `left` and `right` are lost."""
    lost = left, right
    return [
        (eye, number, START + number * PERIOD + eye * MS)
        for number in range(count)
        for eye in (0, 1)
        if number not in lost[eye]
    ]


def pairs(found: list[Coming]) -> list[int]:
    both = [(frame.left, frame.right) for frame in found if frame.complete]
    assert all(left.message == right.message for left, right in both if left and right)
    return [left.message for left, _ in both if left]


def singles(found: list[Coming]) -> list[tuple[int, int]]:
    return [(int(f.left is None), f.first.message) for f in found if not f.complete]


def test_eyes_that_come_in_turns_are_pairs_in_order() -> None:
    found = frames_of(in_turns(5))
    assert pairs(found) == [0, 1, 2, 3, 4]
    assert singles(found) == []
    assert [frame.lost for frame in found] == [0] * 5


@given(st.sets(st.integers(1, 18)), st.sets(st.integers(1, 18)), st.booleans())
@settings(max_examples=200, deadline=None)
def test_each_image_that_comes_is_in_one_frame_and_each_frame_that_does_not_is_counted(
    left: set[int], right: set[int], numbered: bool
) -> None:
    found = frames_of(in_turns(20, left, right), numbered)
    assert pairs(found) == sorted(set(range(20)) - left - right)
    assert sorted(singles(found)) == sorted(
        [(0, n) for n in right - left] + [(1, n) for n in left - right]
    )
    assert sum(frame.lost for frame in found) == (len(left & right) if numbered else 0)


@pytest.mark.parametrize("jump_ns", [-3600 * 10**9, 3600 * 10**9, -PERIOD, 1])
def test_a_clock_that_jumps_costs_no_frame(jump_ns: int) -> None:
    moved = [
        (eye, number, stamp + (jump_ns if number >= 3 else 0))
        for eye, number, stamp in in_turns(8, left={5})
    ]
    found = frames_of(moved)
    assert pairs(found) == [0, 1, 2, 3, 4, 6, 7]
    assert singles(found) == [(1, 5)]


def test_an_eye_that_comes_late_as_a_whole_is_paired() -> None:
    left = [(0, n, START + n * PERIOD) for n in range(10)]
    right = [(1, n, START + n * PERIOD) for n in range(10)]
    late = [*left[:4]]
    for one, other in zip(left[4:], right, strict=False):
        late += [one, other]
    late += right[6:]
    assert pairs(frames_of(late)) == list(range(10))


def test_stamps_farther_apart_than_allowed_are_no_pair() -> None:
    apart = [(eye, n, START + n * PERIOD + eye * 6 * MS) for n in range(3) for eye in (0, 1)]
    assert singles(frames_of(apart)) == [(0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2)]


def test_an_eye_that_is_gone_is_told_soon_and_holds_little() -> None:
    pairer = Pairer(SKEW)
    told = [pairer.add(0, TakenEyes(START + n * PERIOD, n / 15, None)) for n in range(100)]
    assert sum(map(len, told)) == 100 - ROS_MOST_WAITING
    assert pairer.overdue((100 - ROS_MOST_WAITING) / 15 + ROS_PATIENCE_S) == []
    assert len(pairer.overdue(100 / 15 + ROS_PATIENCE_S)) == ROS_MOST_WAITING


def test_a_driver_that_starts_anew_is_no_loss() -> None:
    pairer = Pairer(SKEW)
    numbers = [5, 6, 7, 1, 2]
    found = []
    for place, number in enumerate(numbers):
        for eye in (0, 1):
            found += pairer.add(eye, TakenEyes(START + place * PERIOD, place, None, number))
    assert [frame.lost for frame in found] == [0] * 5


def test_of_frames_that_wait_only_the_newest_pair_keeps_its_images() -> None:
    newest = Newest()
    pixels = np.zeros(1)

    def image(number: int) -> TakenEyes:
        return TakenEyes(START + number * PERIOD, float(number), pixels)

    for coming in (
        Coming(image(0), image(0)),
        Coming(image(1), None),
        Coming(image(2), image(2)),
        Coming(image(3), image(3), lost=2),
        Coming(None, image(4)),
    ):
        newest.add(coming)
    assert newest.last is not None
    assert newest.last.first.stamp_ns == START + 3 * PERIOD
    found = list(newest.take())
    assert [superseded for _, superseded in found] == [True, True, True, False, False]
    held = [frame.first.message is not None for frame, _ in found]
    assert held == [False, False, False, True, False]
    assert [frame.lost for frame, _ in found] == [0, 0, 0, 2, 0]
    assert not newest
