"""``calibrate background``: the model of the empty screen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereo_ore.cli.calibrate.options import writing


def background(
    source: Annotated[
        Path, typer.Argument(help="Recorded pairs of the empty screen, in any known layout.")
    ],
    calib: Annotated[Path, typer.Option("--calib", help="Calibration of the recording.")],
    site: Annotated[
        Path | None, typer.Option("--site", help="Site file: its working volume limits the search.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="Parameters of the matcher.")
    ] = None,
    frames: Annotated[
        int, typer.Option(min=1, max=100, help="How many frames to use, from the first.")
    ] = 16,
    out: Annotated[
        Path, typer.Option(help="NPZ file to write; name it in the site file as `background`.")
    ] = Path("empty_screen.npz"),
) -> None:
    """Model the empty screen, so that `run` knows screen from ore without a plane.

    Example: `stereo-ore calibrate background recordings/empty --calib calib/ours.yaml --site
    site.yaml`
    """
    import numpy as np

    from stereo_ore.io.calibration import load
    from stereo_ore.io.parameters import load_config
    from stereo_ore.io.recordings import open_source
    from stereo_ore.io.site import load_site
    from stereo_ore.stages import matching
    from stereo_ore.stages.rectify import make_rectifier, rectify

    recording = open_source(source)
    rectifier = make_rectifier(load(calib))
    volume = load_site(site).volume if site else None
    settings = load_config(config, ()).matching
    first = matching.find_region(rectifier.rig, volume, settings)
    disparities = []
    for index in range(min(frames, len(recording.names))):
        pair = rectify(recording.read(index), rectifier)
        # The whole region of the volume, not what one frame shows of it: later frames may show
        # other parts.
        region = matching.narrow(pair, first, None, settings)
        disparities.append(matching.match(pair, region, settings))
    model = matching.background.build_background(disparities)
    with writing(out):
        matching.background.save_background(model, out)
    seen = 100 * float(np.isfinite(model.disparity[first.slices]).mean())
    sigma = float(np.nanmedian(model.sigma))
    typer.echo(
        f"{out}: {model.frames} frames, {seen:.0f} % of the region measured, noise {sigma:.2f} px"
    )
