"""Parameters: one pydantic model a stage, with units and ranges."""

from stereo_ore.config.models import (
    CloudConfig,
    Config,
    FilterConfig,
    ForeignConfig,
    GrizzlyConfig,
    HealthConfig,
    MatchingConfig,
    SegmentConfig,
    SolidConfig,
    StrikeConfig,
    VoxelConfig,
)

__all__ = [
    "CloudConfig",
    "Config",
    "FilterConfig",
    "ForeignConfig",
    "GrizzlyConfig",
    "HealthConfig",
    "MatchingConfig",
    "SegmentConfig",
    "SolidConfig",
    "StrikeConfig",
    "VoxelConfig",
]
