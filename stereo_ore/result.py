"""What a pair shows, for people and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stereo_ore.draw import overlay
from stereo_ore.draw.images import encode_png
from stereo_ore.errors import OutputError
from stereo_ore.io.atomic import write_bytes
from stereo_ore.record import record
from stereo_ore.runs.frame_files import cloud_table
from stereo_ore.types import U8, FrameResult, Grizzly, Json, Ore, Reason, Site, Status

if TYPE_CHECKING:
    from open3d.geometry import PointCloud


@dataclass(frozen=True, repr=False)
class Result:
    """Ores and targets of one frame; `frame` holds the arrays of all stages."""

    frame: FrameResult
    site: Site

    @property
    def name(self) -> str:
        """Name of the frame."""
        return self.frame.name

    @property
    def status(self) -> Status:
        """Whether the frame may be acted on: only an "ok" one has targets."""
        return self.frame.status

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What speaks against the frame, or why nothing was found."""
        return self.frame.reasons

    @property
    def counts(self) -> dict[str, int]:
        """How much is left at each step from pixel to target."""
        return dict(self.frame.counts)

    @property
    def grizzly(self) -> Grizzly | None:
        """Plane and bars of the screen."""
        return self.frame.grizzly

    @property
    def ores(self) -> tuple[Ore, ...]:
        """All lumps, by id."""
        return self.frame.ores

    @property
    def targets(self) -> tuple[Ore, ...]:
        """The lumps to strike, best first."""
        by_id = {ore.id: ore for ore in self.ores}
        return tuple(by_id[id] for id in self.frame.targets)

    def to_dict(self) -> Json:
        """Return the record, as a line of ``frames.jsonl`` holds it."""
        return record(self.frame, self.site)

    def to_numpy(self) -> npt.NDArray[np.void]:
        """Return the filtered cloud: x y z [m, camera], red green blue, ore_id (0 = none),
        score.
        """
        return cloud_table(self.frame)

    def to_open3d(self) -> PointCloud:
        """Return the filtered cloud [m, camera] in its colours; imports Open3D."""
        from open3d import geometry, utility

        table = self.to_numpy()
        cloud = geometry.PointCloud()
        xyz = np.stack([table[name] for name in ("x", "y", "z")], 1)
        rgb = np.stack([table[name] for name in ("red", "green", "blue")], 1)
        cloud.points = utility.Vector3dVector(xyz.astype(np.float64))
        cloud.colors = utility.Vector3dVector(rgb / 255.0)
        return cloud

    def overlay(self) -> Picture:
        """Draw the lumps on the left image.

        Raises
        ------
        OutputError
            When the frame has no image.
        """
        image = overlay.draw_overlay(self.frame, record(self.frame, self.site))
        if image is None:
            problem = f"frame {self.name} has no image to draw on: {self._why()}"
            raise OutputError(problem)
        return Picture(image)

    def _why(self) -> str:
        return "; ".join(reason.detail for reason in self.reasons) or self.status

    def __repr__(self) -> str:
        codes = "".join(f", {reason.code}" for reason in self.reasons)
        found = f"{len(self.ores)} ores, {len(self.targets)} targets"
        return f"Result({self.name!r}: {self.status}{codes}, {found})"

    def _repr_html_(self) -> str:
        """Return a table of the lumps for a notebook, targets first."""
        frame = "arm" if self.site.T_arm_camera is not None else "camera"
        heads = (
            "target", "ore", "size [mm]", "volume [l]", "oversize",
            f"centre of gravity, {frame} [m]", f"strike, {frame} [m]",
        )  # fmt: skip
        rank = {id: place for place, id in enumerate(self.frame.targets, 1)}
        rows = sorted(self.ores, key=lambda ore: (rank.get(ore.id, len(rank) + 1), ore.id))
        body = "".join(_row("td", [rank.get(ore.id, ""), *_cells(ore)]) for ore in rows)
        title = escape(repr(self))
        return f"<table><caption>{title}</caption>{_row('th', heads)}{body}</table>"


def _row(tag: str, cells: Any) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"


def _cells(ore: Ore) -> list[object]:
    place = ore.arm or ore
    solid, strike = place.solid, place.strike
    size = " × ".join(f"{1000 * length:.0f}" for length in solid.size_m) if solid else ""
    return [
        ore.id,
        size,
        f"{1000 * solid.volume_m3:.2f}" if solid else "",
        {True: "yes", False: "no", None: "?"}[ore.oversize],
        _vector(solid.centre_of_gravity) if solid else "",
        _vector(strike.point) if strike else ", ".join(r.code for r in ore.plan.reasons),
    ]


def _vector(values: npt.NDArray[np.float64]) -> str:
    return " ".join(f"{value:+.3f}" for value in values)


@dataclass(frozen=True, repr=False)
class Picture:
    """A BGR image (H, W, 3) uint8 that a notebook shows."""

    image: U8

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the picture as PNG.

        Raises
        ------
        OutputError
            When the file can't be written.
        """
        file = Path(path)
        if file.suffix.lower() != ".png":
            raise OutputError("pictures are written as PNG", file=file, remedy="Name a .png file")
        write_bytes(file, self._repr_png_())
        return file

    def _repr_png_(self) -> bytes:
        return encode_png(self.image)

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        return f"Picture({width}×{height} px)"
