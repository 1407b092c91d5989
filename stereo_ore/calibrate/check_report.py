"""The result of a check as text and as a picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereo_ore.calibrate.check import CheckResult
from stereo_ore.calibrate.residual import LIMIT_PX
from stereo_ore.types import U8


def check_report(result: CheckResult) -> str:
    """Lines of text: numbers, the map of row differences, known distances, findings, the
    verdict.
    """
    residual, rig = result.residual, result.rig
    lines = [f"matched features        {residual.matched}, {residual.used} of them agree"]
    if residual.enough:
        turn, sigma = np.degrees(residual.rotation_rad), np.degrees(residual.rotation_sigma_rad)
        low, middle, high = residual.disparity_px
        lines += [
            (
                f"row difference          median {residual.median_px:+.2f} px, systematic"
                f" {residual.systematic_px:.2f} px (wrong from {LIMIT_PX} px), noise"
                f" {residual.noise_px:.2f} px"
            ),
            "implied turn            "
            + ", ".join(f"{a:+.4f} ± {s:.4f}" for a, s in zip(turn, sigma, strict=True))
            + " degrees about x, y, z",
            (
                f"disparity               {low:.1f} … {middle:.1f} … {high:.1f} px, "
                f"distance {' … '.join(_metres(float(rig.depth(d))) for d in (high, middle, low))}"
            ),
            "",
            "row differences over the image [px]:",
            *(
                " ".join("    ·" if np.isnan(cell) else f"{cell:+5.2f}" for cell in row)
                for row in residual.map_px
            ),
        ]
    for point in result.measured:
        lines.append(
            f"known {point.known.distance_m:.3f} m at {point.known.u:g}, {point.known.v:g}: "
            f"measured {_metres(point.distance_m, 3)}, disparity {point.disparity_px:.2f} px, "
            f"should be {point.expected_px:.2f} px"
        )
    findings = [
        f"{finding.severity}: {finding.code}: {finding.text}" for finding in result.findings
    ]
    return "\n".join([*lines, "", *findings, f"verdict: {result.verdict}"])


def _metres(distance: float, digits: int = 2) -> str:
    """A distance as text; disparities of zero and less stand for none."""
    return f"{distance:.{digits}f} m" if np.isfinite(distance) else "beyond infinity"


def draw_check(result: CheckResult, left: U8, path: Path) -> None:
    """Write a PNG: the cells of the image, green where rows agree and red where they do not, with
    the number.
    """
    canvas = left.copy()
    cells = result.residual.map_px
    rows, columns = cells.shape
    height, width = left.shape[:2]
    for (i, j), value in np.ndenumerate(cells):
        if np.isnan(value):
            continue
        top, bottom, x0, x1 = (
            i * height // rows,
            (i + 1) * height // rows,
            j * width // columns,
            (j + 1) * width // columns,
        )
        colour = (60, 160, 60) if abs(value) < LIMIT_PX else (40, 40, 220)
        tile = canvas[top:bottom, x0:x1]
        tile[:] = cv2.addWeighted(tile, 0.6, np.full_like(tile, colour), 0.4, 0)
        size = width / 1600
        cv2.putText(
            canvas,
            f"{value:+.2f}",
            (x0 + 6, (top + bottom) // 2),
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            (255,) * 3,
            1,
            cv2.LINE_AA,
        )
    path.write_bytes(cv2.imencode(".png", canvas)[1].tobytes())
