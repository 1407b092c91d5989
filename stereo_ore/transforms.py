"""Rigid transforms and frames: every transform is named ``T_target_source``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]


def transform_points(T_target_source: _Array, xyz: npt.ArrayLike) -> _Array:
    """Points of the source frame in the target frame.

    Parameters
    ----------
    T_target_source : (4, 4) array
        Homogeneous rigid transform, metres.
    xyz : (..., 3) array
        Points, metres.
    """
    return rotate(T_target_source, xyz) + T_target_source[:3, 3]


def rotate(T_target_source: _Array, vectors: npt.ArrayLike) -> _Array:
    """Directions of the source frame in the target frame; the translation does not act on them."""
    return np.asarray(vectors, dtype=np.float64) @ T_target_source[:3, :3].T


def inverse(T_target_source: _Array) -> _Array:
    """``T_source_target`` of a rigid transform: [Rᵀ, −Rᵀt]."""
    R = T_target_source[:3, :3]
    T = np.eye(4)
    T[:3, :3] = R.T
    T[:3, 3] = -R.T @ T_target_source[:3, 3]
    return T


def rotation_fault(R: _Array, tolerance: float = 1e-4) -> str | None:
    """Why a (3, 3) matrix is not a rotation, or None when it is one."""
    if not np.isfinite(R).all():
        return "has entries that are not finite"
    if (error := float(np.abs(R @ R.T - np.eye(3)).max())) > tolerance:
        return f"is not orthonormal (R Rᵀ differs from the identity by {error:.2g})"
    if np.linalg.det(R) < 0:
        return "is a reflection (determinant −1)"
    return None


def nearest_rotation(M: _Array) -> _Array:
    """The rotation nearest to a (3, 3) matrix."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, np.float64)


def frame_from_normal(normal: _Array, towards: _Array) -> _Array:
    """Right-handed axes as rows: x along ``towards`` projected into the plane, z along ``normal``.

    Parameters
    ----------
    normal : (3,) array
        Unit normal of the plane.
    towards : (3,) array
        Any direction not parallel to the normal.
    """
    x = towards - (towards @ normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])
