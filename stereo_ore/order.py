"""Which lump to break first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_ore.config.models import OrderConfig
from stereo_ore.types import Site, Solid, StrikePlan


def order(
    solids: Sequence[Solid | None], plans: Sequence[StrikePlan], site: Site, config: OrderConfig
) -> tuple[int, ...]:
    """Ids of the lumps that can be struck, best first.

    Oversize lumps come first, then those of unknown size; among equals the higher the strike's score, and the lower
    id at a tie.
    """
    ids = [i for i, plan in enumerate(plans, 1) if plan.strikes]
    urgency = {True: 0, None: 1, False: 2}

    def key(i: int) -> tuple[int, float, int]:
        solid = solids[i - 1]
        return urgency[solid.oversize if solid else None], -np.round(plans[i - 1].strikes[0].score, 6), i

    return tuple(sorted(ids, key=key))
