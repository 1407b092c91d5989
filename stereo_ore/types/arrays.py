"""Array aliases and the shape check that every container makes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Json = dict[str, Any]
"""A JSON object that is being made."""
JsonMapping = Mapping[str, Any]
"""A JSON object that is only read."""

RELIEF_WINDOWS_PX = (14, 36, 72)
"""Sides of the windows whose planes a disparity is held against."""

PIXEL_CUES = ("valid_share", "spread_px", "lr_diff_px", "texture", "photometric", "median_diff_px")
RELIEF_CUES = tuple(
    name
    for n in RELIEF_WINDOWS_PX
    for name in (f"offset_{n}_px", f"scatter_{n}_px", f"support_{n}")
)
CUES = (*PIXEL_CUES, *RELIEF_CUES, "confidence")
"""What the matcher knows about a pixel beside its disparity; `Disparity.cues` and `VoxelCloud.cues`
are keyed by these.

valid_share     share of pixels with a disparity in a window around it, 0…1
spread_px       local spread of disparity (robust standard deviation in a window), px
lr_diff_px      |left-right − right-left| disparity difference, px
texture         root mean square of the horizontal image gradient in a window, grey levels a px
photometric     mean absolute grey difference of the matched windows, less its mean, over the
                texture, dimensionless
median_diff_px  |disparity − its local median|, px
offset_N_px     disparity − the plane fitted to a window of N px around it, px
scatter_N_px    root mean square of the residuals of that plane, px
support_N       share of the window that has a disparity, 0…1
confidence      probability that the disparity is within a pixel of the truth, 0 where there is none
"""

CONTEXT_WINDOWS_PX, CONTEXT_REACH_PX = (15, 41, 101), (9, 25, 61)
AROUND_CUES = (*PIXEL_CUES, "confidence")
KNOWN_CUES = (
    "lr_diff_px", "photometric", "spread_px", "scatter_14_px", "scatter_36_px", "median_diff_px",
    "support_14", "confidence",
)  # fmt: skip
CONTEXT = (
    *(f"{name}_around_{n}" for name in AROUND_CUES for n in CONTEXT_WINDOWS_PX),
    *(f"{name}_known_{n}" for name in KNOWN_CUES for n in CONTEXT_WINDOWS_PX),
    *(f"known_{n}" for n in CONTEXT_WINDOWS_PX),
    *(
        f"{name}_{n}"
        for n in CONTEXT_WINDOWS_PX
        for name in ("off", "deviation", "off_in_deviations")
    ),
    *(f"{name}_{n}" for n in CONTEXT_REACH_PX for name in ("nearer", "farther")),
    *(f"gradient_{axis}_{n}" for axis in "uv" for n in (7, *CONTEXT_WINDOWS_PX[:2])),
    "brightness",
)
"""Cues of voxels that `surroundings.look_around` adds, from windows of N px around each.

CUE_around_N         mean of a pixel's cue
CUE_known_N          mean of the logarithm of a cue (of a support itself, of a confidence the log
                     odds) over the pixels that have a disparity
known_N              their share, 0…1
off_N                sign(o) · log(1 + |o|) of the voxel's disparity o over their mean, px
deviation_N          logarithm of their standard deviation, px
off_in_deviations_N  o over that deviation
nearer_N, farther_N  log(1 + greatest disparity there over the voxel's), and of the voxel's over
                     the least, px
gradient_u_N, _v_N   logarithm of the mean gradient along rows, and along columns, grey levels a px
brightness           logarithm of the mean, grey levels
"""


def check_shape(owner: object, name: str, array: npt.NDArray[Any], *shape: int | None) -> None:
    """Raise ValueError saying what was expected and what came, where None stands for any length."""
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(
            f"{type(owner).__name__}.{name} must have shape ({wanted}), not {array.shape}"
        )
