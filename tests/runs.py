"""A small folder as `run` writes it, made by hand: three frames whose content is known."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.chain import no_counts
from stereo_ore.io import clouds
from stereo_ore.record import record as frame_record
from stereo_ore.types import FrameResult, Site

ROOT = Path(__file__).parents[1]
STAMP = 1_700_000_000_000_000_000
PERIOD = 100_000_000
FIELDS = {
    "x": "<f4",
    "y": "<f4",
    "z": "<f4",
    "red": "u1",
    "green": "u1",
    "blue": "u1",
    "ore_id": "<i4",
    "score": "<f4",
}
COUNTS = ("pixels", "disparities", "points", "voxels", "kept", "ores", "targets")


def ore(
    id: int, oversize: bool | None = True, strike: bool = True, cut: bool = False
) -> dict[str, Any]:
    centre = [0.1 * id, -0.05, 0.95]
    box = {
        "camera": {"centre": centre, "axes": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]},
        "extent_m": [0.3, 0.2, 0.1],
    }
    point = {"camera": [0.1 * id, -0.05, 0.9], "arm": [0.5, 0.1 * id, 0.2]}
    plan = {
        "point": point, "direction": {"camera": [0.0, 0.0, 1.0], "arm": [0.0, 0.6, -0.8]},
        "slope_deg": 8.0, "flatness_m": 0.003, "score": 0.9, "alternates": [],
    }  # fmt: skip
    return {
        "id": id, "points": 100, "pixels": 900, "cut": cut,
        "surface_centroid": {"camera": centre, "arm": None},
        "centre_of_gravity": {"camera": centre, "arm": [1, 2, 3], "sigma_m": [0.01, 0.02, 0.03],
            "method": "test"},
        "volume_m3": 0.004, "volume_bounds_m3": [0.003, 0.005], "size_m": [0.3, 0.2, 0.1],
        "box": box,
        "oversize": oversize, "strike": plan if strike else None,
        "reasons": [] if strike else [{"code": "TOO_STEEP",
            "detail": "no face within the permitted angle"}],
    }  # fmt: skip


def record(
    index: int, ores: list[dict[str, Any]], status: str = "ok", **more: Any
) -> dict[str, Any]:
    targets = [entry["id"] for entry in reversed(ores) if entry["strike"]]
    counts = dict(
        zip(COUNTS, (230400, 90000, 40000, 600, 500, len(ores), len(targets)), strict=True)
    )
    return {
        "schema": "stereo_ore/frame/1", "frame": f"{index:06d}", "index": index,
        "stamp_ns": STAMP + index * PERIOD,
        "status": status, "reasons": [], "units": "m", "camera_frame": "left_rectified",
        "arm_frame": "arm",
        "counts": counts, "grizzly": {"normal": [0, 0, -1.0], "offset_m": -1.0, "source": "site",
            "rms_m": 0.002},
        "ores": ores, "targets": targets,
    } | more  # fmt: skip


def of_today(entry: dict[str, Any], stamp_source: str) -> dict[str, Any]:
    """The same frame as a record of the version that is written now, with a source of its stamp."""
    made = FrameResult(entry["frame"], entry["index"], entry["stamp_ns"], "ok", (), no_counts())
    today = frame_record(made, Site())
    known = {key: value for key, value in entry.items() if key not in ("schema", "grizzly")}
    ores = [{"track": None, "carries": [], "carried_by": [], **lump} for lump in entry["ores"]]
    return today | known | {"stamp_source": stamp_source, "ores": ores}


def cloud(seed: int, count: int = 500) -> clouds.Records:
    rng = np.random.default_rng(seed)
    table = np.zeros(count, list(FIELDS.items()))
    table["x"], table["y"] = rng.uniform(-0.4, 0.4, (2, count))
    table["ore_id"] = (table["x"] > 0.2).astype(int)
    table["z"] = 1.0 - 0.1 * table["ore_id"]
    for name in ("red", "green", "blue"):
        table[name] = rng.integers(0, 256, count)
    table["score"] = rng.uniform(0, 1, count)
    return table


def write_lines(path: Path, entries: list[dict[str, Any]]) -> None:
    path.write_text(
        "".join(
            json.dumps(entry, separators=(",", ":"), ensure_ascii=False) + "\n" for entry in entries
        )
    )


def make_run(
    folder: Path, records: list[dict[str, Any]] | None = None, stages: bool = True
) -> Path:
    """A finished run: two good frames, and one that could not be read and so has no files."""
    folder.mkdir(parents=True)
    failed = record(
        2, [], "failed", reasons=[{"code": "UNPAIRED", "detail": "left2.png: has no right partner"}]
    )
    default = [
        record(0, [ore(1), ore(2, oversize=False)]),
        record(1, [ore(1, strike=False)]),
        failed,
    ]
    records = default if records is None else records
    write_lines(folder / "frames.jsonl", records)
    times = [
        {"frame": entry["frame"], "stages_ms": {"read": 9.0, "match": 100.0}, "total_ms": 109.0}
        for entry in records
    ]
    write_lines(folder / "timings.jsonl", times)
    (folder / "run.json").write_text(
        json.dumps({"source": "recording", "finished": True, "versions": {"numpy": "2"}})
    )
    for name in ("calibration.yaml", "site.yaml"):
        shutil.copy(ROOT / "data" / "paper_03" / name, folder)
    for child in ("clouds", "overlays", "stages"):
        (folder / child).mkdir()
    for entry in records[:12]:
        if entry["status"] != "failed":
            make_frame(folder, entry["frame"], entry["index"], stages)
    return folder


def make_frame(folder: Path, frame: str, seed: int, stages: bool) -> None:
    table = cloud(seed)
    clouds.write(folder / "clouds" / f"{frame}.ply", table)
    picture = np.full((90, 160, 3), (30, 90, 200), np.uint8)
    cv2.imwrite(str(folder / "overlays" / f"{frame}.png"), picture)
    if stages:
        keep = np.arange(600) < 500
        xyz = np.pad(clouds.xyz(table), ((0, 100), (0, 0)), constant_values=0.5).astype(np.float32)
        disparity = np.where(np.indices((90, 160))[1] > 40, np.float32(20), np.float32(np.nan))
        np.savez_compressed(
            folder / "stages" / f"{frame}.npz",
            disparity=disparity, voxel_xyz=xyz, keep=keep, ore_map=np.ones((90, 160), np.int16),
            score=np.where(keep, 0.1, 0.9).astype(np.float32), ore_id=np.zeros(600, np.int32),
        )  # fmt: skip


SMALLER = {  # by how much: image size, focal length, principal point of the demo's calibration
    2: ("[640, 360]", "[264.8, 264.65]", "[320.9, 180.6]"),
    4: ("[320, 180]", "[132.4, 132.325]", "[160.5, 90.3]"),
}


def smaller_scene(folder: Path, divisor: int) -> list[str]:
    """The demo scene at a part of its size in `folder`; arguments of `run` that give calibration
    and site."""
    scene = ROOT / "data" / "paper_03"
    folder.mkdir(parents=True, exist_ok=True)
    for eye in ("left", "right"):
        image = cv2.imread(str(scene / f"{eye}.png"))
        small = cv2.resize(
            image, None, fx=1 / divisor, fy=1 / divisor, interpolation=cv2.INTER_AREA
        )
        cv2.imwrite(str(folder / f"{eye}.png"), small)
    text = (scene / "calibration.yaml").read_text()
    for full, part in zip(
        ("[1280, 720]", "[529.6, 529.3]", "[642.3, 361.7]"), SMALLER[divisor], strict=True
    ):
        assert full in text
        text = text.replace(full, part)
    (folder / "calibration.yaml").write_text(text)
    shutil.copy(scene / "site.yaml", folder)
    return ["--calib", str(folder / "calibration.yaml"), "--site", str(folder / "site.yaml")]


def quarter_scene(folder: Path) -> list[str]:
    """`smaller_scene` at a quarter: a run takes a second."""
    return smaller_scene(folder, 4)
