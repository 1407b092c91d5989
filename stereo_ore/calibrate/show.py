"""What a calibration means: geometry, field of view, depth noise; as text and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.draw.figures import new_figure, save_figure
from stereo_ore.io.calibration.geometry import rotation_vector
from stereo_ore.stages.rectify import Maps, make_rectifier
from stereo_ore.types import CameraModel, Rig, StereoCalibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTANCES_M = (1.0, 2.0, 4.0, 8.0)


def describe_calibration(calibration: StereoCalibration) -> str:
    """Lines of text: cameras as calibrated, the rectified rig, what it sees and how well."""
    rig = make_rectifier(calibration).rig
    sigma = MatchingConfig().sigma_px
    turn = np.degrees(rotation_vector(calibration.R_right_left))
    lines = [
        ("camera", calibration.camera or "(no name)"),
        ("images", f"{rig.width}×{rig.height} px, {calibration.images}"),
        ("left", _eye(calibration.left)),
        ("right", _eye(calibration.right)),
        (
            "turn of the right eye",
            f"{', '.join(f'{angle:.4f}' for angle in turn)} degrees about x, y, z",
        ),
        ("shift", f"{', '.join(f'{1000 * x:.3f}' for x in calibration.t_right_left)} mm"),
        (
            "rectified",
            f"f {rig.fx:.3f} px, centre {rig.cx:.3f}, {rig.cy:.3f} px, doffs {rig.doffs_px:.3f} px",
        ),
        ("baseline", f"{1000 * rig.baseline_m:.3f} mm"),
        ("disparity offset", f"{rig.disparity_offset_px:g} px"),
        ("field of view", "{:.1f}° × {:.1f}°".format(*np.degrees(field_of_view(rig)))),
    ]
    text = "\n".join(f"{name:<22} {value}" for name, value in lines)
    rows = [f"{'at':>6} {'disparity':>12} {'per px':>9} {f'σ at {sigma} px':>13} {'one pixel':>10}"]
    for z in DISTANCES_M:
        step, noise = 1000 * rig.depth_sigma(z, 1.0), 1000 * rig.depth_sigma(z, sigma)
        rows.append(
            f"{z:>4g} m {rig.disparity(z):>9.1f} px {step:>6.1f} mm {noise:>10.1f} mm"
            f" {1000 * z / rig.fx:>7.1f} mm"
        )
    return text + "\n\n" + "\n".join(rows)


def _eye(eye: CameraModel) -> str:
    (fx, fy), (cx, cy) = eye.focal_px, eye.principal_point_px
    lens = (
        f"{eye.projection}, distortion {', '.join(f'{k:g}' for k in eye.distortion)}"
        if eye.distortion
        else "no distortion"
    )
    return f"f {fx:.3f}, {fy:.3f} px, centre {cx:.3f}, {cy:.3f} px, {lens}"


def field_of_view(rig: Rig) -> tuple[float, float]:
    """Horizontal and vertical angle [rad] of the rectified left image."""
    across = np.arctan((rig.cx + 0.5) / rig.fx) + np.arctan((rig.width - 0.5 - rig.cx) / rig.fx)
    down = np.arctan((rig.cy + 0.5) / rig.fy) + np.arctan((rig.height - 0.5 - rig.cy) / rig.fy)
    return float(across), float(down)


def draw_calibration(calibration: StereoCalibration, path: Path) -> None:
    """Write a PNG: how far rectification moves the pixels of each eye, depth noise, and the view
    from above.
    """
    rectifier = make_rectifier(calibration)
    figure = new_figure(11, 7.5, layout="constrained")
    axes = figure.subplots(2, 2)
    for axis, name, maps in zip(
        axes[0], ("left", "right"), (rectifier.left, rectifier.right), strict=True
    ):
        _draw_movement(axis, name, maps, rectifier.rig)
    _draw_noise(axes[1, 0], rectifier.rig)
    _draw_view(axes[1, 1], rectifier.rig)
    figure.suptitle(
        f"{calibration.camera or 'calibration'}: {1000 * rectifier.rig.baseline_m:.1f} mm baseline"
    )
    save_figure(figure, path, dpi=100)


def _draw_movement(axis: Axes, name: str, maps: Maps | None, rig: Rig) -> None:
    axis.set(
        xlim=(0, rig.width),
        ylim=(rig.height, 0),
        aspect="equal",
        title=f"{name}: recorded rectified",
    )
    if maps is None:
        return
    rows = np.linspace(0, rig.height - 1, 20).astype(int)
    columns = np.linspace(0, rig.width - 1, 32).astype(int)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    dx, dy = maps[0][v, u] - u, maps[1][v, u] - v
    length = np.hypot(dx, dy)
    axis.quiver(u, v, dx, dy, length, angles="xy", cmap="viridis")
    axis.set_title(f"{name}: rectification moves pixels by up to {length.max():.1f} px")


def _draw_noise(axis: Axes, rig: Rig) -> None:
    z = np.linspace(0.3, DISTANCES_M[-1], 200)
    for sigma in (0.1, MatchingConfig().sigma_px, 0.5):
        axis.plot(z, 1000 * rig.depth_sigma(z, sigma), label=f"{sigma:g} px of disparity")
    axis.set(title="depth noise", xlabel="distance [m]", ylabel="σ [mm]", yscale="log")
    axis.grid(alpha=0.3)
    axis.legend()


def _draw_view(axis: Axes, rig: Rig) -> None:
    far = DISTANCES_M[-1] / 2
    for shift, colour in ((0.0, "tab:blue"), (rig.baseline_m, "tab:orange")):
        cx = rig.cx + (rig.doffs_px if shift else 0.0)
        edges = (np.array([0, rig.width]) - cx) / rig.fx * far
        axis.fill(
            [shift, shift + edges[0], shift + edges[1]], [0, far, far], alpha=0.3, color=colour
        )
    axis.set(
        title="seen by left (blue) and right eye", xlabel="x [m]", ylabel="z [m]", aspect="equal"
    )
