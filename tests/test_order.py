from dataclasses import replace

import numpy as np
import pytest

from stereo_ore.config.models import OrderConfig
from stereo_ore.stages.order import calmly, order, passing
from stereo_ore.types import Plane, Reason, Site, Solid, Strike, StrikePlan

CONFIG = OrderConfig(include="all")
UP = np.array([0.0, 0.0, -1.0])
SITE = Site(plane=Plane(UP, -2.0))


def solid(oversize: bool | None) -> Solid:
    zero = np.zeros(3)
    return Solid(
        zero,
        zero,
        1.0,
        (0.5, 2.0),
        zero,
        np.eye(3),
        zero,
        zero,
        "",
        np.zeros((4, 3), np.float32),
        oversize,
    )


def strike(x: float = 0.0, height: float = 0.0, score: float = 0.5) -> StrikePlan:
    return StrikePlan((Strike(np.array([x, 0.0, 2.0 - height]), -UP, 0.1, 0.001, score),))


NONE = StrikePlan((), (Reason("TOO_STEEP", ""),))


def test_oversize_first_then_unknown_then_the_rest() -> None:
    solids = [solid(False), solid(None), solid(True), None]
    assert order(solids, [strike()] * 4, SITE, CONFIG) == (3, 2, 4, 1)


def test_what_passes_is_no_target_unless_all_are_wanted() -> None:
    solids = [solid(False), solid(None), solid(True), None]
    assert order(solids, [strike()] * 4, SITE, OrderConfig()) == (3, 2, 4)
    codes = [[reason.code for reason in reasons] for reasons in passing(solids, OrderConfig())]
    assert codes == [["PASSES"], [], [], []]
    assert passing(solids, CONFIG) == ((), (), (), ())


def test_without_a_strike_there_is_no_target() -> None:
    assert order([solid(True), solid(True)], [NONE, strike()], SITE, CONFIG) == (2,)
    assert order([solid(True)], [NONE], SITE, CONFIG) == ()
    assert order([], [], SITE, CONFIG) == ()


def test_what_lies_on_top_goes_first_and_better_strikes_too() -> None:
    two = [solid(True), solid(True)]
    assert order(two, [strike(height=0.1), strike(height=0.4)], SITE, CONFIG) == (2, 1)
    assert order(two, [strike(score=0.2), strike(score=0.9)], SITE, CONFIG) == (2, 1)


def test_the_plane_is_not_needed() -> None:
    assert order(
        [solid(True), solid(True)], [strike(height=0.1), strike(height=0.4)], Site(), CONFIG
    ) == (2, 1)


def test_the_shorter_way_goes_first() -> None:
    reach = replace(
        SITE,
        T_arm_camera=np.eye(4),
        reach_min_m=np.array([-1, -1, 1.0]),
        reach_max_m=np.array([1, 1, 3.0]),
    )
    two = [solid(True), solid(True)]
    assert order(two, [strike(x=0.9), strike(x=0.1)], reach, CONFIG) == (2, 1)
    assert order(two, [strike(x=0.9), strike(x=0.1)], SITE, CONFIG) == (1, 2)


@pytest.mark.parametrize("seed", range(5))
def test_noise_does_not_reorder_equals(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plans = [strike(score=0.5 + 1e-4 * rng.standard_normal()) for _ in range(6)]
    assert order([solid(True)] * 6, plans, SITE, CONFIG) == (1, 2, 3, 4, 5, 6)


def test_the_order_does_not_depend_on_the_order_of_the_rest() -> None:
    rng = np.random.default_rng(0)
    solids = [solid(bool(k % 2)) for k in range(7)]
    plans = [strike(height=rng.uniform(0, 1), score=rng.uniform(0, 1)) for _ in range(7)]
    turned = rng.permutation(7)
    first = order(solids, plans, SITE, CONFIG)
    second = order([solids[i] for i in turned], [plans[i] for i in turned], SITE, CONFIG)
    assert tuple(int(turned[i - 1]) + 1 for i in second) == first


def test_noise_does_not_change_the_order_of_the_frame_before() -> None:
    total, before = np.array([5.0, 5.1, 5.9, 5.05]), [0, 1, 2, None]
    assert calmly(total, before, CONFIG) == [2, 0, 3, 1]
    assert calmly(total, before, OrderConfig(calm=2.0)) == [0, 1, 3, 2]
    assert calmly(total, [None] * 4, CONFIG) == [2, 1, 3, 0]
    assert calmly(np.array([1.0]), [None], CONFIG) == [0]
