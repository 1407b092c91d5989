"""Tables and picture of `bench speed`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from stereo_ore.draw.figures import new_figure, save_figure
from stereo_ore.lab.bench.growth import GrowthRow, n_log_n
from stereo_ore.lab.bench.speed import PLAIN, FrameCost
from stereo_ore.lab.bench.tables import table


def speed_markdown(
    frames: Sequence[FrameCost], growth: Sequence[GrowthRow], machine: Mapping[str, Any]
) -> str:
    """All tables."""
    about = (
        f"{machine['cores']} cores ({machine['processor']}), OpenCV {machine['opencv']}, load"
        f" {machine['load']:.1f}"
    )
    parts = [f"Measured on {about}; medians of rounds in which all take turns."]
    if frames:
        parts += [_frames(frames), _memory(frames)]
    if growth:
        parts.append(_growth(growth))
    return "\n\n".join(part for part in parts if part) + "\n"


def _title(cost: FrameCost) -> str:
    return f"{cost.size}, {'site' if cost.site else 'no site'}"


def _frames(frames: Sequence[FrameCost]) -> str:
    stages = [name for name in max((cost.stages_ms for cost in frames), key=len) if name != "files"]
    head = ["ms", *map(_title, frames)]
    rows = [[name, *(_ms(cost.stages_ms.get(name)) for cost in frames)] for name in stages]
    rows.append(["**a frame, file to record**", *(f"**{cost.frame_ms:.0f}**" for cost in frames)])
    rows.append(["cloud and overlay on disk", *(_ms(cost.files_ms) for cost in frames)])
    rows.append(["status", *(cost.status for cost in frames)])
    rows.append(["voxels", *(f"{cost.counts['voxels']:,}" for cost in frames)])
    rows.append(["disparities of the plain matchers", *(str(cost.disparities) for cost in frames)])
    for name in PLAIN:
        rows.append([f"plain {name}", *(_ms(cost.plain_ms[name]) for cost in frames)])
    for name in PLAIN:
        rows.append(
            [f"**frame / {name}**", *(f"**{cost.frame_ratio[name]:.2f}**" for cost in frames)]
        )
        rows.append(
            [f"after matching / {name}", *(f"{cost.after_ratio[name]:.2f}" for cost in frames)]
        )
    note = "Plain is `StereoSGBM.compute` on grey, rectified images, whole, one direction."
    return f"**What a frame costs.** {note}\n\n{table(head, rows)}"


def _memory(frames: Sequence[FrameCost]) -> str:
    measured = [cost for cost in frames if cost.peak_mb is not None]
    if not measured:
        return ""
    stages = max((cost.stage_peaks_mb for cost in measured), key=len)
    rows = [[name, *(_mb(cost.stage_peaks_mb.get(name)) for cost in measured)] for name in stages]
    rows.append(["**a frame**", *(f"**{_mb(cost.peak_mb)}**" for cost in measured)])
    note = "Peak resident set of the process in each stage, Python and libraries included."
    return f"**Memory.** {note}\n\n{table(['MB', *map(_title, measured)], rows)}"


def _growth(rows: Sequence[GrowthRow]) -> str:
    names, sizes = (
        list(dict.fromkeys(row.filter for row in rows)),
        list(dict.fromkeys(row.points for row in rows)),
    )
    found = {(row.filter, row.points): row for row in rows}
    cells = [[f"{n:,}", *(_cell(found[name, n]) for name in names)] for n in sizes]
    steps = [_growth_step(found, names, small, large) for small, large in pairwise(sizes)]
    note = (
        "Seconds, and MB by which the process grew; – was left out for its time. The last rows:"
        " time over that of the smaller cloud, scaled by n log n."
    )
    return (
        f"**The filter on larger clouds.** {note}\n\n{table(['points', *names], [*cells, *steps])}"
    )


def _growth_step(
    found: Mapping[tuple[str, int], GrowthRow], names: Sequence[str], small: int, large: int
) -> list[str]:
    def ratio(name: str) -> str:
        before, after = found[name, small].seconds, found[name, large].seconds
        if before is None or after is None:
            return "–"
        return f"{after / before * n_log_n(small) / n_log_n(large):.2f}"

    return [f"{small:,} → {large:,}", *map(ratio, names)]


def _cell(row: GrowthRow) -> str:
    if row.seconds is None:
        return "–"
    return f"{row.seconds:.3g}" + ("" if row.extra_mb is None else f" ({row.extra_mb:,.0f})")


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"


def _mb(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"


def draw_speed(frames: Sequence[FrameCost], growth: Sequence[GrowthRow], path: Path) -> None:
    """Write a picture: stages of a frame as stacked bars beside the plain matchers, and the
    filters' growth.
    """
    figure = new_figure(13, 5.5, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_frames(left, frames)
    for name in dict.fromkeys(row.filter for row in growth):
        points = [
            (row.points, row.seconds)
            for row in growth
            if row.filter == name and row.seconds is not None
        ]
        right.loglog(*zip(*points, strict=True), marker="o", label=name)
    right.set(xlabel="points", ylabel="seconds", title="Filters on larger clouds")
    right.grid(alpha=0.3)
    if growth:
        right.legend()
    save_figure(figure, path, dpi=110)


def _draw_frames(axis: Any, frames: Sequence[FrameCost]) -> None:
    stages = [
        name
        for name in max((cost.stages_ms for cost in frames), key=len, default={})
        if name != "files"
    ]
    bottom = [0.0] * len(frames)
    places = range(len(frames))
    for name in stages:
        heights = [cost.stages_ms.get(name, 0.0) for cost in frames]
        axis.bar(places, heights, 0.55, bottom, label=name)
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    for name, marker in zip(PLAIN, "_x", strict=True):
        plain = [cost.plain_ms[name] for cost in frames]
        size = 300 if marker == "_" else 60
        axis.scatter(
            places, plain, s=size, c="black", marker=marker, label=f"plain {name}", zorder=3
        )
    axis.set_xticks(list(places), [_title(cost).replace(", ", "\n") for cost in frames])
    axis.set(ylabel="ms a frame", title="Stages of a frame")
    if frames:
        axis.legend(fontsize=8, ncols=2)
