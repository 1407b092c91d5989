"""Figures outside pyplot, which keeps global state and looks for a display."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereo_ore.errors import MissingExtraError, OutputError

_log = logging.getLogger(__name__)


def new_figure(width_in: float, height_in: float, **options: Any) -> Any:
    """An empty matplotlib Figure that can be drawn without a display.

    Raises
    ------
    MissingExtraError
        When matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), **options)
    FigureCanvasAgg(figure)
    return figure


def require_matplotlib() -> None:
    """Refuse at once what would need a picture later.

    Raises
    ------
    MissingExtraError
        When matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise MissingExtraError("matplotlib", "pictures") from None


def if_possible(draw: Callable[[], object]) -> None:
    """Draw a picture that nobody asked for by name; without matplotlib say so and go on."""
    try:
        draw()
    except MissingExtraError as error:
        _log.warning("no picture: %s", error)


def save_figure(figure: Any, path: Path, dpi: int | str = "figure") -> None:
    """Write a figure in the format that its name says, without the writer's version, so that bytes
    can be compared.

    Raises
    ------
    OutputError
        When the file can't be written or its format is not known.
    """
    metadata = {"Software": None} if path.suffix.lower() == ".png" else None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi, metadata=metadata)
    except (OSError, ValueError) as fault:
        reason = getattr(fault, "strerror", None) or str(fault)
        raise OutputError(
            f"can't be written: {reason}", file=path, remedy="Name a .png, .pdf or .svg file"
        ) from None
