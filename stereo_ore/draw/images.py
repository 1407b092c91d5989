"""Pictures as files."""

from __future__ import annotations

import cv2

from stereo_ore.types import U8

PNG_SETTINGS = [
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
    # Trying all filters a row, as OpenCV 5 does unasked, doubles the time and saves nothing; OpenCV
    # 4.10 has one only.
    *(
        (cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
        if hasattr(cv2, "IMWRITE_PNG_FILTER")
        else ()
    ),
]
"""Fast rather than small: an overlay is looked at, then thrown away."""


def encode_png(image: U8, level: int = 1) -> bytes:
    """Return a BGR image as a PNG file; level 0 does not compress it, for one that is read again at
    once.
    """
    settings = [cv2.IMWRITE_PNG_COMPRESSION, level, *PNG_SETTINGS]
    return cv2.imencode(".png", image, settings)[1].tobytes()
