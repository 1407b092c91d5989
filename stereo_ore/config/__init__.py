"""Parameters: one pydantic model a stage, read from YAML and ``--set``, written back resolved."""

from stereo_ore.config.models import (
    CloudConfig,
    Config,
    FilterConfig,
    GrizzlyConfig,
    HealthConfig,
    MatchingConfig,
    SegmentConfig,
    SolidConfig,
    StrikeConfig,
    VoxelConfig,
)
from stereo_ore.config.validation import nearest, validate
from stereo_ore.io.parameters import dump_config, load_config

__all__ = [
    "CloudConfig",
    "Config",
    "FilterConfig",
    "GrizzlyConfig",
    "HealthConfig",
    "MatchingConfig",
    "SegmentConfig",
    "SolidConfig",
    "StrikeConfig",
    "VoxelConfig",
    "dump_config",
    "load_config",
    "nearest",
    "validate",
]
