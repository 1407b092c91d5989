"""Which lumps lie on others."""

import numpy as np
import pytest

from stereo_ore.stages.stack import carried
from stereo_ore.types import Plane, Solid

PLANE = Plane(np.array([0.0, 0.0, -1.0]), -2.0)
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def block(x: float, height: float, size: float = 0.4, thick: float = 0.2) -> Solid:
    """A block whose underside is `height` above the bars, in a camera's frame that looks down."""
    centre = np.array([x, 0.0, 2.0 - height - thick / 2])
    extent = np.array([size, size, thick])
    vertices = (centre + CORNERS * extent / 2).astype(np.float32)
    return Solid(
        centre, np.zeros(3), 1.0, (0.5, 2.0), centre, np.eye(3), extent, extent, "", vertices
    )


def test_the_upper_of_two_blocks_is_carried() -> None:
    assert carried([block(0.0, 0.0), block(0.1, 0.2)], PLANE) == ((2, 1),)
    assert carried([block(0.1, 0.2), None, block(0.0, 0.0)], PLANE) == ((1, 3),)


def test_a_block_on_two_others_is_carried_by_both() -> None:
    assert carried([block(-0.22, 0.0), block(0.22, 0.0), block(0.0, 0.2)], PLANE) == (
        (3, 1),
        (3, 2),
    )


@pytest.mark.parametrize(
    "other",
    [block(0.41, 0.0), block(0.35, 0.2), block(0.0, 0.6), None],
    ids=["beside", "hardly over", "flies", "not made"],
)
def test_nothing_is_carried_by_what_lies_beside_or_far_below(other: Solid | None) -> None:
    assert carried([block(0.0, 0.0), other], PLANE) == ()
