"""Every parameter of the program with its default, unit and range: one model a stage."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)
from pydantic_core import PydanticCustomError


class StageConfig(BaseModel):
    """Immutable; an unknown key, a NaN or an infinity is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def param(default: Any, text: str, unit: str = "", **limits: Any) -> Any:
    """A field with a description and a unit; `limits` are pydantic's (ge, gt, le, lt)."""
    return Field(
        default, description=text, json_schema_extra={"unit": unit} if unit else None, **limits
    )


MAX_PIXELS = 100_000_000


class SourceConfig(StageConfig):
    """Recorded images."""

    max_pixels: int = param(
        MAX_PIXELS, "largest picture that is decoded; of a larger one the frame fails", "px", ge=1
    )


class MatchingConfig(StageConfig):
    """Semi-global matching (OpenCV StereoSGBM) and what is done to its disparities."""

    mode: Literal["sgbm", "3way", "hh", "hh4"] = param("3way", "path directions of SGBM")
    block_size: Annotated[int, Field(ge=1, le=15)] | Literal["auto"] = param(
        "auto", "side of the matching window, odd; auto: 3, or 5 where the image is noisy", "px"
    )
    p1: int = param(8, "penalty of a one-level disparity step, times block_size²", ge=0)
    p2: int = param(32, "penalty of a larger step, more than p1, times block_size²", ge=1)
    uniqueness: int = param(0, "margin by which the best cost must win", "%", ge=0, le=50)
    pre_filter_cap: int = param(
        21, "truncation of the prefiltered gradient, odd", "grey levels", ge=15, le=63
    )
    min_disparity: int | None = param(
        None, "smallest disparity searched; null: 0, or from the working volume", "px"
    )
    num_disparities: int | None = param(
        None,
        "disparities searched; null: from the working volume, or a fifth of the image width",
        "px",
        ge=16,
    )
    use_region: bool = param(
        True, "search only the image region and the disparities that the working volume can show"
    )
    narrow: bool = param(
        True, "look at a small copy of each pair first, and search only what it shows"
    )
    min_confidence: float = param(
        0.4,
        "disparities less likely than this to be within a pixel of the truth are left to the"
        " filter",
        ge=0,
        lt=1,
    )
    lr_max_diff: float = param(
        2.0, "left-right difference above which a disparity is dropped", "px", gt=0
    )
    speckle_size: int = param(
        40, "connected disparities, this many or fewer, are dropped (0: off)", "px", ge=0
    )
    speckle_range: float = param(1.0, "step that separates them", "px", gt=0)
    even_light: bool = param(
        True,
        "make the eyes' brightness alike, or match normalised images, where more of a small copy"
        " agrees so",
    )
    fuse: int = param(
        1, "frames of a still scene, from each one on, that are measured as one", ge=1, le=64
    )
    min_texture: float = param(
        0.2,
        "horizontal gradient (RMS in 5 px) below which a pixel is flat or saturated, and has no"
        " disparity",
        "grey levels a px",
        ge=0,
    )
    sigma_px: float = param(0.15, "standard deviation of a disparity, for depth noise", "px", gt=0)

    @field_validator("block_size", "pre_filter_cap")
    @classmethod
    def _odd(cls, value: int | str) -> int | str:
        """Refuse what OpenCV would take for the next odd number."""
        if isinstance(value, int) and value % 2 == 0:
            raise ValueError(f"must be odd; OpenCV would take {value + 1}")
        return value

    @field_validator("p2")
    @classmethod
    def _more_than_p1(cls, value: int, info: ValidationInfo) -> int:
        """Refuse what OpenCV would take for p1 + 1."""
        if value <= info.data.get("p1", -1):
            raise ValueError(
                f"must be more than p1 ({info.data['p1']}): a large step can't cost less than a"
                " small one"
            )
        return value


class CloudConfig(StageConfig):
    """Reprojection of disparities into the cloud."""

    max_depth_m: float = param(20.0, "farther points are dropped", "m", gt=0, le=5000)


LARGEST_VOXEL_M = 0.5
"""Larger ones hold whole lumps."""


def _voxel_edge(value: float | str) -> float | str:
    """Refuse edges that can't be, in the words of other limits."""
    if not isinstance(value, str) and value <= 0:
        raise PydanticCustomError("greater_than", "Input should be greater than 0")
    if not isinstance(value, str) and value > LARGEST_VOXEL_M:
        limit = {"limit": LARGEST_VOXEL_M}
        raise PydanticCustomError(
            "less_than_equal", "Input should be less than or equal to {limit}", limit
        )
    return value


class VoxelConfig(StageConfig):
    """The voxel grid."""

    size_m: Annotated[float | Literal["auto"], AfterValidator(_voxel_edge)] = param(
        "auto",
        f"edge of a voxel, up to {LARGEST_VOXEL_M} m; auto: `pixels` × pixel size at the screen",
        "m",
    )
    pixels: float = param(
        3.4, "edge of an automatic voxel in pixels at the middle of the scene", "px", gt=0
    )


class FilterConfig(StageConfig):
    """The outlier filter; its parameters belong to the method."""

    method: str = param(
        "adaptive",
        "adaptive | closed-form | paper | paper-tuned | statistical | radius | lof | none",
    )
    params: dict[str, Any] = param({}, "parameters of the method that differ from its defaults")


class GrizzlyConfig(StageConfig):
    """Finding the plane of the bar tops when the site does not give it."""

    distance_m: float | None = param(
        None, "inlier distance of the plane; null: from the depth noise", "m", gt=0, le=1
    )
    max_tilt_rad: float | None = param(
        None, "largest angle between screen normal and viewing direction", "rad"
    )
    iterations: int = param(500, "RANSAC hypotheses", ge=10)
    seed: int = param(0, "seed of the RANSAC")
    sigmas: float = param(2.5, "inlier distance in standard deviations of the depth noise", gt=0)
    min_contrast: float = param(
        0.03, "share of what is solid and open that bars must explain in a screen", ge=0, le=1
    )
    min_bars: int = param(
        3, "bars to be seen where neither opening nor working volume is known", ge=1
    )
    refinements: int = param(2, "times the plane found is fitted again to its bars", ge=0)


class ModelsConfig(StageConfig):
    """What is learned, where it is not what ships with the package."""

    lumps: str = param("shipped", "folder of the network of lumps: model.onnx and card.json")


class ForeignConfig(StageConfig):
    """What is in view and is no ore: the arm itself, chains, posts, people."""

    find: bool = param(True, "look for what stands or hangs over the screen and is no ore")
    min_stance: float = param(
        1.2, "height over all around it, in its own widths, from which on a part is no ore", gt=0
    )
    margin: float = param(
        0.08, "band around a body that is no ore either, in openings: depth is smeared there", ge=0
    )
    clearance: float = param(0.3, "distance that strikes keep from a body, in openings", ge=0)
    max_share: float = param(
        0.1,
        "share of the view that bodies found may cover before all targets are withheld",
        ge=0,
        le=1,
    )


class SegmentConfig(StageConfig):
    """Lumps in the image."""

    min_size_m: float = param(
        0.04, "lumps whose visible width is smaller are dropped, and counted", "m", gt=0, le=5
    )
    min_pixels: int = param(
        240, "and of fewer visible pixels: no more than a clump of wrong matches", "px", ge=1
    )
    ore_probability: float = param(0.5, "pixels more likely ore than this are", gt=0, lt=1)
    agreement: float = param(
        0.35, "share of a lump's votes that must agree on its middle and size", gt=0, lt=1
    )
    line_probability: float = param(
        0.3, "pixels more likely the contact of two lumps than this part them", gt=0, lt=1
    )
    lump_probability: float = param(
        0.4, "labels less likely one whole lump than this are dropped, and counted", ge=0, lt=1
    )
    small_pixels: int = param(
        600, "a lump of fewer visible pixels may be a clump of wrong matches", "px", ge=0
    )
    doubtful_probability: float = param(
        0.6, "small ones, and cut ones, are dropped if less likely", ge=0, lt=1
    )
    least_measured: float = param(
        0.3, "share of a lump's pixels that the filter kept in the working volume", ge=0, lt=1
    )
    band: float = param(
        0.06,
        "how far around an outline the image is looked at for its edge, in openings",
        gt=0,
    )
    default_opening_m: float = param(
        0.3, "scale of the lumps when no opening is known", "m", gt=0, le=3
    )


class SolidConfig(StageConfig):
    """The unseen side of a lump."""

    min_points: int = param(30, "lumps with fewer visible points get no solid", ge=4)
    oversize_margin: float = param(
        0.03, "least share of the opening within which oversize is unknown", ge=0, le=0.5
    )
    volume_sigmas: float = param(
        2.0, "half width of the volume's bounds in standard deviations of its logarithm", gt=0
    )
    bias_share: float = param(
        0.5, "error common to all disparities of a lump, over the noise of one", ge=0, le=5
    )


class StrikeConfig(StageConfig):
    """Where the tool may strike."""

    tool_diameter_m: float = param(0.04, "diameter of the chisel", "m", gt=0, le=1)
    max_slope_rad: float = param(
        0.6,
        "largest angle between face normal and the tool's axis (the screen's normal)",
        "rad",
        gt=0,
        le=1.57,
    )
    clearance_m: float = param(
        0.005,
        "distance kept from edges, neighbours and bars beyond the tool's radius",
        "m",
        ge=0,
        le=1,
    )
    max_roughness_m: float = param(
        0.006, "residual of a flat patch, beside the depth noise", "m", gt=0, le=1
    )
    min_measured: float = param(0.7, "share of a patch that must have a depth", ge=0, lt=1)
    max_depth_sigma: float = param(
        0.018, "standard deviation of a depth there, over the distance", gt=0, lt=1
    )
    lever_share: float = param(
        0.2,
        "distance from the normal through the centre of gravity, over the longest dimension, that"
        " halves a score",
        gt=0,
    )
    alternates: int = param(3, "ranked alternates reported", ge=0)


MOST_CONFIRMING = 100
"""Frames that may be asked to confirm a target."""


class OrderConfig(StageConfig):
    """Which lump to break first: a weighted sum, highest first."""

    include: Literal["oversize", "all"] = param(
        "oversize", "what is a target: lumps that can't pass or may be unable to, or all lumps"
    )
    confirm: str = param(
        "1 of 1",
        "N of M: a target must have been the same lump in N of the last M good frames",
    )
    oversize_weight: float = param(
        4.0, "for a lump that can't pass; half of it when that is unknown", ge=0
    )
    height_weight: float = param(
        1.0, "for a strike higher than others, over the highest: what lies on top goes first", ge=0
    )
    strike_weight: float = param(1.0, "for the strike's score", ge=0)
    travel_weight: float = param(
        0.5, "against the arm's way from the middle of its reach, over the longest way", ge=0
    )
    resolution: float = param(
        0.02, "differences of the sum below this are ties, which the id decides", gt=0
    )
    calm: float = param(
        0.25, "difference of the sums that changes the order of the frame before", ge=0
    )

    @field_validator("confirm")
    @classmethod
    def _n_of_m(cls, value: str) -> str:
        """Refuse what is not N of M frames, with N up to M."""
        words = re.fullmatch(r"(\d{1,3}) of (\d{1,3})", value)
        if words is None or not 1 <= int(words[1]) <= int(words[2]) <= MOST_CONFIRMING:
            raise ValueError(f"must be N of M, as 3 of 5, with 1 ≤ N ≤ M ≤ {MOST_CONFIRMING}")
        return value

    @property
    def confirming(self) -> tuple[int, int]:
        """N and M of `confirm`."""
        n, _, m = self.confirm.split()
        return int(n), int(m)


class HealthConfig(StageConfig):
    """Self-checks: what makes a frame degraded, so that it gives no target."""

    min_disparity_share: float = param(
        0.2, "share of the pixels searched that must have a disparity", ge=0, lt=1
    )
    min_right_share: float = param(
        0.3,
        "share of the textured pixels that must be matched rightly, by the confidence of each",
        ge=0,
        lt=1,
    )
    max_row_shift_rad: float = param(
        0.00025, "row difference of the matched eyes, over the focal length", "rad", gt=0
    )
    max_local_row_shift_px: float = param(
        0.4, "and what a part of the image may differ by beyond that", "px", gt=0
    )
    min_brightness: float = param(
        24, "grey level that 5 % of the pixels reach, in the darker eye", ge=0, le=255
    )
    min_fine_detail: float = param(
        0.014, "energy of the finest detail in both eyes, over that of coarse detail", ge=0
    )
    min_detail_ratio: float = param(
        0.5, "detail of a lump in the eye that shows less of it, over the other's", ge=0, le=1
    )
    max_screen_offset: float = param(
        4.0,
        "distance of the screen seen from the site's plane, in standard deviations of a depth",
        gt=0,
    )
    max_screen_tilt_rad: float = param(
        0.026, "angle between them, or more where noise makes more", "rad", gt=0, lt=1
    )
    max_bar_shift: float = param(
        0.1,
        "largest distance of bars from their place that is corrected, in openings",
        gt=0,
        le=0.5,
    )
    max_bar_shift_px: float = param(0.15, "or in disparity, where that is more", "px", ge=0, le=1)
    max_bar_turn_rad: float = param(
        0.0175, "largest turn of bars about the screen's normal", "rad", gt=0, le=0.2
    )
    max_bar_drift: float = param(
        0.04, "change of their place over a run that is told, in openings", gt=0, le=0.5
    )
    max_bad_rows: float = param(
        0.04, "share of the rows in which bars may be measured elsewhere", ge=0, le=1
    )
    least_screen: float = param(
        0.15, "share of the points that a plane must have to be the screen", gt=0, lt=1
    )
    refuse_frozen: bool = param(
        True, "a frame with an eye's image equal to an earlier one, to the pixel, is degraded"
    )
    frozen_history: int = param(
        64, "earlier frames looked at: a ring buffer repeats itself", ge=1, le=10_000
    )
    min_of_usual: float = param(
        0.6, "share of the valid disparities that good frames before had", ge=0, lt=1
    )
    history: int = param(20, "good frames that say what is usual", ge=5, le=10_000)


class Config(StageConfig):
    """All parameters of a run."""

    source: SourceConfig = SourceConfig()
    matching: MatchingConfig = MatchingConfig()
    cloud: CloudConfig = CloudConfig()
    voxel: VoxelConfig = VoxelConfig()
    filter: FilterConfig = FilterConfig()
    grizzly: GrizzlyConfig = GrizzlyConfig()
    models: ModelsConfig = ModelsConfig()
    foreign: ForeignConfig = ForeignConfig()
    segment: SegmentConfig = SegmentConfig()
    solid: SolidConfig = SolidConfig()
    strike: StrikeConfig = StrikeConfig()
    order: OrderConfig = OrderConfig()
    health: HealthConfig = HealthConfig()
