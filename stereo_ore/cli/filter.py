"""``stereo-ore filter``: the outlier filter alone, on cloud files."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereo_ore.errors import CloudError

if TYPE_CHECKING:
    from stereo_ore.types import FilterResult

_log = logging.getLogger(__name__)

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}

LARGEST_M = 30.0
"""A cloud wider than this many units is hardly in metres: then the unit is asked for."""

MILDER = {
    "adaptive": "threshold=0.6",
    "closed-form": "threshold=0.99",
    "paper": "R=1.4",
    "paper-tuned": "R=1.8",
    "statistical": "ratio=2",
    "radius": "spacings=5",
    "lof": "threshold=2",
}
"""What to say for less to be removed."""

MUCH = 0.4
"""A share removed above this is warned of: few clouds hold so much noise."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command("filter")(filter_)


def filter_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IN", help="Cloud: .ply .pcd .xyz .txt .asc .pts .csv .npy .npz .las .laz"
        ),
    ],
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Kept points, any of these formats, all columns kept."),
    ],
    method: Annotated[
        str,
        typer.Option(
            help="adaptive, closed-form, paper, paper-tuned, statistical, radius, lof or none."
        ),
    ] = "adaptive",
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the method: key=value.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the cloud's coordinates: m, cm or mm.")
    ] = None,
    scores: Annotated[
        Path | None, typer.Option(help="Write keep and score of each point, best .npz or .csv.")
    ] = None,
    keep_noise: Annotated[Path | None, typer.Option(help="Write the removed points too.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the outlier factors; *-kept beside it shows both.")
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            help=(
                "Take statistical or radius and their parameters as open3d, pcl, cloudcompare or"
                " cars (cars-filter) "
                "mean them, and keep exactly the points that it keeps."
            )
        ),
    ] = None,
) -> None:
    """Remove noise from a point cloud.

    Coordinates stay as they are in the file; its unit matters for parameters that are lengths.

    adaptive: surfaces with outliers at, or not far from, them, at any density and roughness, and
    clouds that are clean. closed-form: the same without anything learned; weaker on outliers close
    to a surface. paper, paper-tuned: the published filter, for comparison. statistical, radius:
    sparse outliers far from a surface of even density (k and n don't count the point itself). lof:
    the same where density varies. Sheets of points beside a surface are noise to none of them.

    Example: `stereo-ore filter scan.ply clean.ply --method adaptive --keep-noise noise.ply
    --picture factors.png`
    """
    from stereo_ore.io import clouds
    from stereo_ore.io.parameters import load_config
    from stereo_ore.stages import filters
    from stereo_ore.types import centred_cloud

    config = load_config(
        None, [f"filter.method={method}", *(f"filter.params.{text}" for text in settings or [])]
    ).filter
    params = filters.parameters(config)
    for path in (out, keep_noise, scores):
        if path:
            _check_output(path, source)
    records, viewpoint = clouds.read(source), clouds.viewpoint(source)
    xyz = clouds.xyz(records)
    metres = _metres(source, xyz, unit)
    if like is None:
        result = filters.apply(centred_cloud(xyz * metres), config)
    else:
        result = filters.apply_like(like, xyz, params, metres)
    clouds.write(out, records[result.keep], viewpoint)
    if keep_noise:
        clouds.write(keep_noise, records[~result.keep], viewpoint)
    if scores:
        clouds.write(scores, clouds.from_columns({"keep": result.keep, "score": result.score}))
    if picture:
        _draw(xyz, result, picture)
    _report(result)


def _check_output(path: Path, source: Path) -> None:
    from stereo_ore.io import clouds

    clouds.format_of(path)
    if path.exists() and source.exists() and path.samefile(source):
        raise CloudError(
            "is the input",
            file=path,
            remedy="Name another file; the recorded cloud is not replaced",
        )


def _metres(source: Path, xyz: Any, unit: str | None) -> float:
    """Metres a unit; asks when the extent makes metres unlikely, and never guesses."""
    import numpy as np

    if unit is not None:
        if unit not in METRES:
            raise CloudError(
                f"{unit!r} is no unit of length known here", key="--unit", remedy="Use m, cm or mm"
            )
        return METRES[unit]
    finite = xyz[np.isfinite(xyz).all(1)]
    width = (
        float(np.ptp(np.quantile(finite, (0.01, 0.99), axis=0), axis=0).max())
        if len(finite)
        else 0.0
    )
    if width > LARGEST_M:
        remedy = "Say --unit mm (or --unit m if it is that large)"
        raise CloudError(
            f"the cloud is {width:,.0f} units wide: are they millimetres?",
            file=source,
            remedy=remedy,
        )
    return METRES["m"]


def _draw(xyz: Any, result: FilterResult, picture: Path) -> None:
    from stereo_ore.draw import filter_pictures

    filter_pictures.outlier_factors(xyz, result.score, picture)
    kept = picture.with_name(f"{picture.stem}-kept{picture.suffix}")
    filter_pictures.side_by_side(xyz, {str(result.diagnostics["method"]): result.keep}, kept)


def _report(result: FilterResult) -> None:
    d = result.diagnostics
    removed = d["points"] - d["kept"]
    share = 100 * removed / max(d["points"], 1)
    _log.info(
        "%s: %s of %s points removed (%.1f %%)",
        d["method"],
        f"{removed:,}",
        f"{d['points']:,}",
        share,
    )
    if share > 100 * MUCH and d["points"]:
        milder = f"a milder --set {MILDER[d['method']]}, or " if d["method"] in MILDER else ""
        _log.warning("%.0f %% of the cloud is gone; are there good points among them (--picture)? "
                    "Then use %sanother --method", share, milder)  # fmt: skip
    for key, words in (
        ("not_finite", "rows without finite coordinates"),
        ("duplicates", "points at the same place"),
    ):
        if d[key]:
            _log.info("%s %s", f"{d[key]:,}", words)
