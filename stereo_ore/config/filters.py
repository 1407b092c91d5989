"""Parameters of the filters: one model a method. Lengths left at null follow the cloud's own
spacing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from stereo_ore.config.models import StageConfig, param


class NoneParams(StageConfig):
    """The filter that keeps every point has no parameters."""


class StatisticalParams(StageConfig):
    """Mean distance to the nearest neighbours against its distribution over the cloud."""

    k: int = param(20, "neighbours", ge=1, le=200)
    ratio: float = param(1.0, "standard deviations above the mean that are still kept", gt=0)


class RadiusParams(StageConfig):
    """Neighbours within a radius."""

    n: int = param(8, "neighbours that must lie within the radius", ge=1, le=200)
    radius_m: float | None = param(
        None, "radius; null: `spacings` × median spacing of the cloud", "m", gt=0, le=10
    )
    spacings: float = param(3.0, "radius in median spacings", gt=0)


class LofParams(StageConfig):
    """Local outlier factor of Breunig et al. (2000), by reachability distances."""

    k: int = param(20, "neighbours", ge=1, le=200)
    threshold: float = param(1.5, "factor above which a point is noise", gt=0)


class PaperParams(StageConfig):
    """The published adaptive-K density filter; symbols as printed."""

    k0: int = param(10, "base K of the density ρ of equation 2", ge=1, le=100)
    k_grid: tuple[int, ...] = param((5, 10, 15, 20, 25, 30), "values of k tried for K_σ")
    k_sigma: int | None = param(
        None, "K_σ; null: the k of the grid with the greatest mean of σ", ge=1, le=200
    )
    alpha: float = param(5.0, "α, weight of μ_ρ/ρ in equation 5", ge=0)
    beta: float = param(1.0, "β, weight of K_σ in equation 5", ge=0)
    k_min: int = param(3, "smallest K_i", ge=1, le=200)
    k_max: int = param(40, "largest K_i", ge=1, le=200)
    R: float = param(1.0, "outlier factor above which a point is noise", gt=0)
    centres: tuple[float, float] = param(
        (0.1, 0.9), "starting centres of the two clusters of ρ, noise first"
    )
    centres_as: Literal["quantile", "density"] = param(
        "quantile", "what `centres` are: quantiles of ρ, or ρ in 1/m"
    )
    density_at: Literal["k0", "k_i"] = param(
        "k0", "the ρ that enters equation 6: at k0, or at each point's own K_i"
    )


class AdaptiveParams(StageConfig):
    """Adaptive-K density, residual to the local surface, and the matcher's doubts where it hands
    them on.
    """

    k: int = param(16, "neighbours; the scorers that ship were trained with 16", ge=6, le=100)
    threshold: float | None = param(
        None, "noise probability above which a point is removed; null: the scorer's own", gt=0, lt=1
    )
    scorer: Path | None = param(None, "a scorer from `tune --train`; null: the one that ships")


class ClosedFormParams(StageConfig):
    """The adaptive filter's equation without anything learned."""

    k: int = param(16, "neighbours", ge=6, le=100)
    scale: float = param(
        0.15, "least s, distance from a plane that halves a vote, in spacings", gt=0
    )
    roughness: float = param(
        1.5, "s in standard deviations of the cloud's own residuals, where that is more", ge=0
    )
    support: float = param(0.2, "S₀, support at which a point is as likely noise as not", gt=0)
    rounds: int = param(
        5, "times the planes are fitted to what the round before believed", ge=1, le=50
    )
    threshold: float = param(0.95, "p above which a point is noise", gt=0, lt=1)
