"""The figures of one frame: matching, filter, ores, solids, strikes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import SourceError
from stereo_ore.lab import metrics
from stereo_ore.lab.evaluate.truth import Truth
from stereo_ore.types import F32, F64, Mask

_TOOL = 255
"""Instance of the breaker's hammer in scenes with truth."""

HIT_IOU = 0.5
DOUBTFUL_FLAG = 0.05
"""Lumps whose middle dimension is this close to the opening, as a share of it, don't count for the
oversize flag."""

STATISTICAL_GRID = [(k, s) for k in (10, 20, 50) for s in (0.2, 0.5, 1.0, 2.0)]
RADIUS_GRID = [(n, r) for r in (2, 3, 5) for n in (4, 8, 16, 32)]
"""Settings of Open3D's filters (neighbours, deviation or radius in spacings), of which the best
counts."""


def score(
    record: Mapping[str, Any],
    stages: Mapping[str, npt.NDArray[Any]],
    truth: Truth,
    baselines: bool = True,
) -> dict[str, Any]:
    """All figures of a frame; lengths in mm, angles in degrees, shares 0…1.

    Parameters
    ----------
    record : mapping
        The frame's line of frames.jsonl.
    stages : mapping
        Its arrays: disparity, voxel_xyz, keep, ore_map.
    truth : Truth
        What is true of the scene.
    baselines : bool
        Also judge Open3D's statistical and radius filter on the same voxels, each at its best of a
        grid.

    Returns
    -------
    dict
        scene, status, match, filter, baseline, ores, solid, strike, and `lumps`: a row for each
        wanted lump.
    """
    ore = (truth.instance >= 2) & (truth.instance != _TOOL)
    if stages["disparity"].shape != ore.shape:
        problem = (
            f"is of images of {stages['disparity'].shape[::-1]} pixels, the truth of"
            f" {ore.shape[::-1]}"
        )
        raise SourceError(
            f"the result of {record['frame']} {problem}",
            file=truth.name,
            remedy="Is it this scene's?",
        )
    xyz, keep = stages["voxel_xyz"], stages["keep"].astype(bool)
    noise = metrics.is_noise(xyz, truth.disparity, truth.K, truth.focal_baseline)
    quality = metrics.filter_quality(noise, ~keep).as_dict()
    shares = {"noise_share": _mean(noise), "noise_left": _mean(noise[keep])}
    matched, found = _match(stages["ore_map"], truth)
    rows = _lump_rows(record, truth, matched)
    return {
        "scene": truth.name,
        "status": record["status"],
        "match": asdict(metrics.disparity_quality(stages["disparity"], truth.disparity, ore)),
        "filter": quality | shares,
        "baseline": tuned_baselines(xyz, noise) if baselines else None,
        "ores": _ores(rows, matched, found, truth) | _on_tool(stages["ore_map"], found, truth),
        "solid": {
            key: _column(rows, key) for key in ("cog_xy", "cog_z", "cog_rel", "volume", "size")
        },
        "strike": {"distance": _column(rows, "strike_mm"), "angle": _column(rows, "strike_deg")},
        "lumps": rows,
    }


def tuned_baselines(xyz: F32, noise: Mask) -> dict[str, Any]:
    """Equation 7 of Open3D's two filters, each with the settings of its grid that suit this cloud
    best.
    """
    import open3d as o3d
    from scipy.spatial import cKDTree

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(float)))
    some = xyz[:: max(1, len(xyz) // 4000)]
    spacing = (
        float(np.median(np.asarray(cKDTree(xyz).query(some, k=2)[0])[:, 1]))
        if len(xyz) > 1
        else 1.0
    )
    statistical = (cloud.remove_statistical_outlier(k, s)[1] for k, s in STATISTICAL_GRID)
    radius = (cloud.remove_radius_outlier(n, r * spacing)[1] for n, r in RADIUS_GRID)
    return {"statistical": _best(statistical, noise), "radius": _best(radius, noise)}


def _best(candidates: Any, noise: Mask) -> dict[str, float]:
    best = {"f1": 0.0}
    for keep in candidates:
        removed = np.ones(len(noise), bool)
        removed[np.asarray(keep, int)] = False
        quality = metrics.filter_quality(noise, removed).as_dict()
        best = quality if quality["f1"] > best["f1"] else best
    return best


def _match(
    ore_map: npt.NDArray[Any], truth: Truth
) -> tuple[dict[int, tuple[int, float]], list[int]]:
    """For each matched true lump the found id and its IoU; and all found ids."""
    found = [int(i) for i in np.unique(ore_map) if i > 0]
    true_ids = sorted(truth.lumps)
    iou = metrics.iou_matrix(truth.instance, ore_map, true_ids, found)
    pairs = metrics.best_pairs(iou) if iou.size else []
    return {true_ids[a]: (found[b], float(iou[a, b])) for a, b in pairs}, found


def _lump_rows(
    record: Mapping[str, Any], truth: Truth, matched: dict[int, tuple[int, float]]
) -> list[dict[str, Any]]:
    """A row for each wanted lump: what is true of it, its IoU, and the errors of its record when it
    was hit.
    """
    records = {ore["id"]: ore for ore in record["ores"]}
    rows = []
    for id_ in truth.wanted:
        lump = truth.lumps[id_]
        found, iou = matched.get(id_, (0, 0.0))
        row = {
            "id": id_, "iou": iou, "hit": iou >= HIT_IOU,
            "found": found if iou >= HIT_IOU else None,
            "visible_fraction": lump["visible_fraction"], "size_mm": lump["max_caliper_mm"],
            "distance_mm": float(np.linalg.norm(truth.centre(id_))) * 1000,
            "is_oversize": lump["oversize"],
        }  # fmt: skip
        if iou >= HIT_IOU and found in records:
            row |= _solid_errors(records[found], lump, truth, id_) | _strike_errors(
                records[found], truth, id_
            )
        rows.append(row)
    return rows


def _solid_errors(
    ore: Mapping[str, Any], lump: Mapping[str, Any], truth: Truth, id_: int
) -> dict[str, Any]:
    """Errors of centre, volume, size and oversize flag; keys of what the record leaves open are
    missing.
    """
    row: dict[str, Any] = {}
    if ore["centre_of_gravity"] is not None and ore["centre_of_gravity"]["arm"] is not None:
        error = np.array(ore["centre_of_gravity"]["arm"]) * 1000 - np.array(lump["com_world_mm"])
        row["cog_xy"], row["cog_z"] = metrics.split_along(error, truth.normal)
        row["cog_rel"] = float(np.linalg.norm(error)) / lump["max_caliper_mm"]
        offset = np.abs(np.array(ore["centre_of_gravity"]["camera"]) - truth.centre(id_))
        row["inside_2_sigma"] = float(
            (offset <= 2 * np.array(ore["centre_of_gravity"]["sigma_m"])).mean()
        )
    if ore.get("volume_m3"):
        row["volume"] = abs(ore["volume_m3"] * 1e9 / lump["volume_mm3"] - 1)
        low, high = ore["volume_bounds_m3"]
        row["inside_bounds"] = bool(low * 1e9 <= lump["volume_mm3"] <= high * 1e9)
    if ore["size_m"] is not None:
        row["size"] = abs(max(ore["size_m"]) * 1000 / lump["max_caliper_mm"] - 1)
    clear_case = abs(lump["obb_dims_mm"][1] / (truth.opening_m * 1000) - 1) > DOUBTFUL_FLAG
    if ore.get("oversize") is not None and clear_case:
        row["flag_ok"] = ore["oversize"] == lump["oversize"]
    return row


def _strike_errors(ore: Mapping[str, Any], truth: Truth, id_: int) -> dict[str, float]:
    if not ore.get("strike"):
        return {}
    point, direction = (
        np.array(ore["strike"]["point"]["camera"]),
        np.array(ore["strike"]["direction"]["camera"]),
    )
    distance, angle = metrics.surface_distance_and_angle(point, direction, _surface(truth, id_))
    return {"strike_mm": distance * 1000, "strike_deg": float(np.degrees(angle))}


def _surface(truth: Truth, id_: int) -> F64:
    """True surface points (N, 3) [m] of a lump in the rectified left camera."""
    v, u = np.nonzero(truth.instance == id_)
    z = truth.depth[v, u]
    K = truth.K
    return np.stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z], 1)


def _ores(
    rows: list[dict[str, Any]],
    matched: dict[int, tuple[int, float]],
    found: list[int],
    truth: Truth,
) -> dict[str, Any]:
    wanted = {row["id"] for row in rows}
    used = {ore for id_, (ore, iou) in matched.items() if iou >= HIT_IOU or id_ not in wanted}
    oversize, flags = [row for row in rows if row["is_oversize"]], _column(rows, "flag_ok")
    return {
        "wanted": len(rows), "hit": sum(row["hit"] for row in rows), "predicted": len(found),
        "false": len([i for i in found if i not in used]),
        "iou": float(np.mean([row["iou"] for row in rows])) if rows else None,
        "oversize": len(oversize), "oversize_hit": sum(row["hit"] for row in oversize),
        "flag_ok": int(np.sum(flags)), "flag_n": len(flags),
    }  # fmt: skip


def _on_tool(ore_map: npt.NDArray[Any], found: list[int], truth: Truth) -> dict[str, Any]:
    """Ores that are by more than half the breaker's hammer, and whether it is in view."""
    tool = truth.instance == _TOOL
    ores = [i for i in found if tool[ore_map == i].mean() > 0.5]
    return {"on_tool": len(ores), "tool_in_view": bool(tool.any())}


def _column(rows: list[dict[str, Any]], key: str) -> list[Any]:
    return [row[key] for row in rows if key in row]


def _mean(values: Mask) -> float:
    return float(values.mean()) if len(values) else 0.0
