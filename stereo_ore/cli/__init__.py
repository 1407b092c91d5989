"""The command line: one module a verb; `launch` is the one place that catches."""

from __future__ import annotations

import importlib
import logging
import os
import sys
from io import TextIOWrapper
from typing import Annotated, NoReturn

import typer

from stereo_ore import installation, memory
from stereo_ore.cli.logs import JsonLines, LogFormat
from stereo_ore.errors import OutputError, StereoOreError
from stereo_ore.version import __version__

VERBS = (
    "run",
    "calibrate",
    "site",
    "config",
    "synth",
    "serve",
    "replay",
    "evaluate",
    "filter",
    "bench",
    "report",
    "tune",
    "view",
    "export",
    "doctor",
    "example",
)
"""Modules of this package; each has ``register(app)``."""

EXIT_KNOWN_ERROR, EXIT_USAGE, EXIT_QUALITY = 1, 2, 3

app = typer.Typer(
    name="stereo-ore",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"stereo-ore {__version__}")
        raise typer.Exit


@app.callback()
def main(
    verbose: Annotated[int, typer.Option("-v", "--verbose", count=True, help="More messages.")] = 0,
    quiet: Annotated[
        bool, typer.Option("-q", "--quiet", help="Only warnings, no progress.")
    ] = False,
    log_format: Annotated[
        LogFormat, typer.Option("--log-format", help="Messages as text, or as a line of JSON each.")
    ] = LogFormat.TEXT,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """Find breaking-size ore on a grizzly screen in recorded stereo pairs.

    Example: `stereo-ore run data/paper_03 --calib data/paper_03/calibration.yaml --site
    data/paper_03/site.yaml --out out`
    """
    level = logging.WARNING if quiet else (logging.INFO, logging.DEBUG)[min(verbose, 1)]
    handler = logging.StreamHandler(sys.stderr)
    if log_format is LogFormat.JSON:
        handler.setFormatter(JsonLines())
    logging.basicConfig(format="%(message)s", handlers=[handler], force=True)
    logging.getLogger("stereo_ore").setLevel(level)
    os.environ["STEREO_ORE_DEBUG"] = "1" if debug else ""


def load_verbs() -> None:
    """Register every verb on `app`; the modules import heavy packages only when a verb runs."""
    if not app.registered_commands and not app.registered_groups:
        for verb in VERBS:
            importlib.import_module(f"stereo_ore.cli.{verb}").register(app)


def launch(arguments: list[str] | None = None) -> None:
    """Run the command line; known errors end as one line and exit code 1."""
    memory.keep_freed()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(
            stream, TextIOWrapper
        ):  # names of files may hold what the terminal's encoding has not
            stream.reconfigure(errors="backslashreplace")
    try:
        load_verbs()
        app(arguments)
    except StereoOreError as error:
        _end(error)
    except (ImportError, AttributeError) as fault:
        _tell_conflict(fault)
        raise
    except BrokenPipeError:
        # The reader of our output went away (`| head`): no message helps, and Python must not try
        # to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_KNOWN_ERROR)
    except OSError as fault:
        # What no reader or writer has foreseen: a name too long, a folder that may not be entered.
        _end(
            OutputError(
                fault.strerror or str(fault),
                file=fault.filename,
                remedy="Check path, space and permissions",
            )
        )
    except MemoryError:
        _end(OutputError("not enough memory", remedy="Use smaller images or fewer --workers"))


def _tell_conflict(fault: Exception) -> None:
    """End in one line when OpenCV is broken by another wheel of it."""
    if "cv2" in str(fault) and (found := installation.conflicting_wheels()):
        _end(StereoOreError(f"{fault}: {installation.conflict_text(found)}"))


def _end(error: StereoOreError) -> NoReturn:
    """One line for a known error; all of it with ``--debug``."""
    if os.environ.get("STEREO_ORE_DEBUG"):
        raise error
    typer.echo(f"error: {error}", err=True)
    sys.exit(EXIT_KNOWN_ERROR)
