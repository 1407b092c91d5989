"""The values that flow from stage to stage: frozen, their shapes checked when they are made.

Units are metres, pixels, radians and nanoseconds. The frame is the rectified left camera (x right, y down, z forward)
unless a name says otherwise. A missing measurement is NaN.
"""

from stereo_ore.types.arrays import (
    CUES,
    F32,
    F64,
    I16,
    I32,
    PIXEL_CUES,
    RELIEF_CUES,
    RELIEF_WINDOWS_PX,
    U8,
    Mask,
    check_shape,
)
from stereo_ore.types.geometry import CameraModel, Plane, Region, Rig, Site, StereoCalibration, Volume
from stereo_ore.types.results import FrameResult, Ore, Reason, Solid, Status, Strike, StrikePlan
from stereo_ore.types.stages import (
    Background,
    Bars,
    Disparity,
    FilterResult,
    Grizzly,
    OreMap,
    PointCloud,
    RectifiedPair,
    Registration,
    StereoPair,
    Surface,
    VoxelCloud,
    bare_cloud,
)

__all__ = [
    "CUES",
    "F32",
    "F64",
    "I16",
    "I32",
    "PIXEL_CUES",
    "RELIEF_CUES",
    "RELIEF_WINDOWS_PX",
    "U8",
    "Background",
    "Bars",
    "CameraModel",
    "Disparity",
    "FilterResult",
    "FrameResult",
    "Grizzly",
    "Mask",
    "Ore",
    "OreMap",
    "Plane",
    "PointCloud",
    "Reason",
    "RectifiedPair",
    "Region",
    "Registration",
    "Rig",
    "Site",
    "Solid",
    "Status",
    "StereoCalibration",
    "StereoPair",
    "Strike",
    "StrikePlan",
    "Surface",
    "Volume",
    "VoxelCloud",
    "bare_cloud",
    "check_shape",
]
