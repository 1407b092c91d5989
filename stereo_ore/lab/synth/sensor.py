"""From radiance to 8 bit: blur, exposure, contrast, shot and read noise."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.lab.synth.spec import Sensor
from stereo_ore.types import F32, U8

_BLUR_PX = 0.55
WHITE_PERCENTILE, WHITE_LEVEL = 98.0, 0.36


def exposure_gain(sensor: Sensor, radiance: F32) -> float:
    """Factor that brings the left eye's bright parts to `WHITE_LEVEL` of full scale, times the
    scene's exposure.
    """
    level = float(np.percentile(radiance.mean(-1)[::4, ::4], WHITE_PERCENTILE))
    return sensor.exposure * WHITE_LEVEL / max(level, 1e-6)


def expose(sensor: Sensor, radiance: F32, gain: float, rng: np.random.Generator) -> U8:
    """An 8-bit image (H, W, 3) of linear radiance times `gain`.

    Electrons are Poisson with mean full_well · signal (normal approximation), read noise is added,
    and the result is encoded with gamma 1/2.2. Contrast below 1 draws tones together about a middle
    grey, as a flat lens or dust does.
    """
    signal = cv2.GaussianBlur(radiance, (0, 0), _BLUR_PX) * np.float32(gain)
    signal = sensor.contrast * signal + (1 - sensor.contrast) * 0.15
    electrons = sensor.full_well * np.clip(signal, 0, None)
    sigma = np.sqrt(electrons + sensor.read_noise**2)
    noisy = (
        electrons + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    ) / sensor.full_well
    return np.asarray(np.clip(noisy, 0, 1) ** (1 / 2.2) * 255 + 0.5).clip(0, 255).astype(np.uint8)
