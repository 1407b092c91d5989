"""Array aliases and the shape check that every container makes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

RELIEF_WINDOWS_PX = (14, 36, 72)
"""Sides of the windows whose planes a disparity is held against."""

PIXEL_CUES = ("valid_share", "spread_px", "lr_diff_px", "texture", "photometric", "median_diff_px")
RELIEF_CUES = tuple(name for n in RELIEF_WINDOWS_PX for name in (f"offset_{n}_px", f"scatter_{n}_px", f"support_{n}"))
CUES = PIXEL_CUES + RELIEF_CUES
"""What the matcher knows about a pixel beside its disparity; `Disparity.cues` and `VoxelCloud.cues` are keyed by these.

valid_share     share of pixels with a disparity in a window around it, 0…1
spread_px       local spread of disparity (robust standard deviation in a window), px
lr_diff_px      |left-right − right-left| disparity difference, px
texture         root mean square of the horizontal image gradient in a window, grey levels a px
photometric     mean absolute grey difference of the matched windows, less its mean, over the texture, dimensionless
median_diff_px  |disparity − its local median|, px
offset_N_px     disparity − the plane fitted to a window of N px around it, px
scatter_N_px    root mean square of the residuals of that plane, px
support_N       share of the window that has a disparity, 0…1
"""


def check_shape(owner: object, name: str, array: npt.NDArray[Any], *shape: int | None) -> None:
    """Raise ValueError saying what was expected and what came, where None stands for any length."""
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(f"{type(owner).__name__}.{name} must have shape ({wanted}), not {array.shape}")
