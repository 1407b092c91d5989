"""Markdown of the benchmark, and its place in the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereo_ore.errors import OutputError


def filter_markdown(document: dict[str, Any]) -> str:
    """The tables of a `bench filter` result."""
    parts = [_section("The paper's protocol", document["paper"])]
    titles = {
        "planted": "Outliers planted on scans",
        "stereo": "Stereo clouds",
        "real": "Real stereo clouds",
    }
    parts += [
        _section(title, document[key]) for key, title in titles.items() if document[key]["cells"]
    ]
    parts.append(_clean(document["clean"]))
    return "\n\n".join([*parts, *map(_speed, document["speed"])]) + "\n"


def _section(title: str, part: dict[str, Any]) -> str:
    cells, summary = part["cells"], part["summary"]
    filters = list(summary["f1"])
    head = ["cloud", "noise", *filters, "P_r", "Recall", "Retain", "left", "bars kept"]
    names = list(dict.fromkeys(cell["cell"] for cell in cells))
    rows = [_cells(name, [c for c in cells if c["cell"] == name], filters) for name in names]
    mean = ["**mean**", "", *(percent(summary["f1"][name]) for name in filters), "", "", "", "", ""]
    best = (
        "Best tuned baseline, mean of each cloud's best: F1"
        f" {percent(summary['best_tuned_baseline_f1'])} %."
    )
    note = (
        "F1 in % (baselines: best of a grid on each cloud); the last five columns are"
        f" {filters[-1]}'s. {best}"
    )
    return f"**{title}.** {note}\n\n{table(head, [*rows, mean])}"


def _cells(name: str, cells: Sequence[dict[str, Any]], filters: Sequence[str]) -> list[str]:
    by_filter = {cell["filter"]: cell for cell in cells}
    ours = by_filter[filters[-1]]
    figures = [
        percent(ours[key])
        for key in ("precision", "recall", "retention", "noise_left", "bars_kept")
    ]
    return [
        name,
        percent(ours["noise_share"]),
        *(percent(by_filter[f]["f1"]) for f in filters),
        *figures,
    ]


def _clean(rows: Sequence[dict[str, Any]]) -> str:
    names = [name for name in rows[0] if name != "cell"]
    body = [[row["cell"], *(percent(row[name]) for name in names)] for row in rows]
    note = "Share removed in %, each filter as shipped: every point lost is a good one."
    return f"**Clouds without an outlier.** {note}\n\n{table(['cloud', *names], body)}"


def _speed(speed: dict[str, float]) -> str:
    base = speed["open3d_statistical"]
    ratios = ", ".join(f"{name} {speed[name] / base:.1f} times" for name in ("adaptive", "paper"))
    return (
        f"**Time** at {speed['points']:,.0f} points, K = {speed['k']:.0f}, in one process: Open3D's"
        f" `remove_statistical_outlier` {base:.0f} ms; {ratios} that."
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table, numbers to the right."""
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def percent(share: float | None) -> str:
    """A share 0…1 in per cent, or a dash."""
    return "–" if share is None else f"{100 * share:.1f}"


def insert(readme: Path, name: str, text: str) -> None:
    """Put text between ``<!-- name -->`` and ``<!-- /name -->`` of a file.

    Raises
    ------
    OutputError
        When the file can't be read or written or the markers aren't there, in this order.
    """
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    try:
        old = readme.read_text(encoding="utf-8")
        before, found, rest = old.partition(start)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            raise OutputError(
                f"lacks the lines {start} and {end}",
                file=readme,
                remedy="Add them where the table goes",
            )
        readme.write_text(f"{before}{start}\n{text}{end}{after}", encoding="utf-8")
    except OSError as fault:
        raise OutputError(f"can't be used: {fault.strerror}", file=readme) from None
