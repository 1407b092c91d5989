"""Left and right images that belong together by their stamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Pair = tuple[int | None, int | None]


def pair_by_stamp(left_ns: Sequence[int], right_ns: Sequence[int], max_skew_ns: int) -> list[Pair]:
    """Indices of left and right images in order of time; None where an eye has no partner.

    Two images are partners when each is the other's nearest and they are at most `max_skew_ns`
    apart, so an image is used once and a lost one shifts nothing. Stamps are ascending.
    """
    left, right = np.asarray(left_ns, np.int64), np.asarray(right_ns, np.int64)
    if len(left) == 0 or len(right) == 0:
        return [(i, None) for i in range(len(left))] + [(None, j) for j in range(len(right))]
    partner, back = _nearest(left, right), _nearest(right, left)
    together = (back[partner] == np.arange(len(left))) & (
        np.abs(right[partner] - left) <= max_skew_ns
    )
    pairs: list[Pair] = [(i, int(partner[i]) if together[i] else None) for i in range(len(left))]
    used = set(partner[together].tolist())
    pairs += [(None, j) for j in range(len(right)) if j not in used]
    return sorted(pairs, key=lambda pair: (_stamp(pair, left_ns, right_ns), pair[0] is None))


def _stamp(pair: Pair, left_ns: Sequence[int], right_ns: Sequence[int]) -> int:
    i, j = pair
    if i is not None:
        return left_ns[i]
    assert j is not None, "a pair has an image"
    return right_ns[j]


def _nearest(values: npt.NDArray[np.int64], others: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Index of the nearest of the ascending `others` for each value; the earlier one of two as
    near.
    """
    after = np.clip(np.searchsorted(others, values), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    nearer_before = np.abs(values - others[before]) <= np.abs(others[after] - values)
    return np.where(nearer_before, before, after)
