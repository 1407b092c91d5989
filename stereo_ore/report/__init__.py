"""``report.html``: one file that shows a run, opens without a network, and is made from the run's
folder alone.
"""

from __future__ import annotations

from pathlib import Path

from stereo_ore.io.atomic import write_text
from stereo_ore.io.results import Results
from stereo_ore.report.data import page_data
from stereo_ore.report.page import render

__all__ = ["write_report"]


def write_report(folder: Path) -> Path:
    """Write ``report.html`` into the folder of a run, finished or not; its path.

    Raises
    ------
    SourceError
        When the folder holds no run.
    MissingExtraError
        Without the plotly package, whose JavaScript the page carries.
    OutputError
        When the file can't be written.
    """
    path = folder / "report.html"
    write_text(path, render(page_data(Results(folder)), title=folder.resolve().name))
    return path
