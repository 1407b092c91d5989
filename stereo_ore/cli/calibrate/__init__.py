"""``stereo-ore calibrate``: make and judge calibrations and sites."""

from __future__ import annotations

import typer

from stereo_ore.cli.calibrate import background, files, hand_eye, judge, make


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    group = typer.Typer(
        no_args_is_help=True, help="Make and judge the YAML files of camera and site."
    )
    group.command("import")(files.import_)
    group.command()(files.show)
    group.command()(make.stereo)
    group.command("hand-eye")(hand_eye.hand_eye)
    group.command()(judge.check)
    group.command()(background.background)
    app.add_typer(group, name="calibrate")
