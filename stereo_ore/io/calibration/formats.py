"""What the readers of calibration files share."""

from __future__ import annotations

import contextlib
import gzip
import json
import logging
import re
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import COEFFICIENTS, Images, other_units
from stereo_ore.io.npz_io import load_arrays
from stereo_ore.io.yaml_io import MAX_BYTES, decode_text, read_text
from stereo_ore.transforms import rotation_fault
from stereo_ore.types import F64, StereoCalibration

_log = logging.getLogger(__name__)

Projection = Literal["pinhole", "equidistant"]

LONGEST_UNSAID_M = 1.0
"""A longer baseline in a format without a unit is in metres only when the user says so."""

_LENS_WORDS = re.compile(
    r"dist|coef|lens|fish|radial|tangential|prism|kannala|polynom|equidist|omni|(?:^|[^a-z])xi\d?(?![a-z])|model|tilt|tau"
    r"|(?:^|[^a-z])[kpsd]_?\d+(?![a-z0-9])|(?:^|[^a-z])[dk](?![a-z0-9])|(?:^|[^a-z])d_?(?:left|right|l|r|fe)(?![a-z])"
)
_NO_MODEL = re.compile(r"distance|std|stdev|cov|uncertain|error|rms|per_?view")
"""Entries about a lens that are no part of its model."""


@dataclass(frozen=True)
class Hints:
    """What a file may not say of itself.

    Attributes
    ----------
    images
        What the recorded images are; None: what the file says or implies.
    image_size
        Width and height [px] of one eye as the user gave it, for formats that hold several or none.
    unit_m
        Length of one unit of the translation, for formats that do not fix it; None: metres, where
        that is likely.
    eyes
        Which two cameras of a chain are left and right; None: the chain has just two.
    projection
        Of both lenses, for files that do not say it.
    recorded_size
        Width and height [px] of the images at hand: picks one of several sizes in a file, never
        stands for one.
    """

    images: Images | None = None
    image_size: tuple[int, int] | None = None
    unit_m: float | None = None
    eyes: tuple[int, int] | None = None
    projection: Projection | None = None
    recorded_size: tuple[int, int] | None = None


class Format(Protocol):
    """What a module of a calibration format offers."""

    def recognises(self, text: str) -> bool:
        """Whether the text of a file is in this format."""

    def read(self, path: Path, text: str, hints: Hints) -> StereoCalibration:
        """The calibration in it."""


SIZE_REMEDY = "Give it with calibrate import --size WxH"


OTHER_FILE = "a calibration as text (YAML, JSON or XML)"
_ZIP = b"PK\x03\x04"
_MAGIC = {
    b"\x89HDF\r\n\x1a\n": "an HDF5 file",
    _ZIP: "a zip archive",
    b"MATLAB": "a MATLAB file",
    b"\x93NUMPY": "a NumPy array",
    b"\x80": "a Python pickle, which is never loaded",
}
_REMEDIES = {
    b"MATLAB": "Write it as JSON in MATLAB: writelines(jsonencode(toStruct(stereoParams)),"
    " 'stereo.json')",
}
_TAR_MAGIC = slice(257, 262), b"ustar"


def read_file(path: Path) -> str:
    """The text of a calibration file, also of one that is packed with gzip; of an NPZ its arrays as
    JSON.

    Raises
    ------
    CalibrationError
        Naming what the file is by its first bytes, when it is no text.
    """
    try:
        with path.open("rb") as file:
            head = file.read(8)
            if head.startswith(b"\x1f\x8b"):
                file.seek(0)
                with gzip.open(file) as unpacked:
                    return _unpacked(unpacked.read(MAX_BYTES + 1), path)
    except (OSError, EOFError, zlib.error, ValueError) as fault:
        if isinstance(fault, FileNotFoundError) or not path.is_file():
            return read_text(path, CalibrationError)
        raise CalibrationError(f"is no whole gzip file: {fault}", file=path) from None
    if head.startswith(_ZIP) and path.suffix.lower() == ".npz":
        return _arrays_as_json(path)
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            beside = ", ".join(
                file.name
                for file in sorted(path.parent.glob(f"{path.stem}_TransformationMatrix.json"))
            )
            remedy = _REMEDIES.get(magic) or f"Name {beside or OTHER_FILE} instead"
            raise CalibrationError(f"is {kind}, not a text file", file=path, remedy=remedy)
    return read_text(path, CalibrationError)


def _unpacked(data: bytes, path: Path) -> str:
    """The text of what was compressed."""
    place, magic = _TAR_MAGIC
    if data[place] == magic:
        remedy = "Unpack it (tar xf) and name a file in it, such as camera_calibration's left.yaml"
        raise CalibrationError("is an archive of files", file=path, remedy=remedy)
    return decode_text(data, path, CalibrationError)


def _arrays_as_json(path: Path) -> str:
    if path.stat().st_size > MAX_BYTES:
        raise CalibrationError(f"has more than {MAX_BYTES:,} bytes; no more are read", file=path)
    arrays = {
        name: array.tolist()
        for name, array in load_arrays(path, CalibrationError, MAX_BYTES).items()
        if array.dtype.kind in "iufb"
    }
    return json.dumps(arrays)


def size_of(path: Path, in_file: Sequence[Any] | None, hints: Hints) -> tuple[int, int]:
    """The image size that the file gives or, when it gives none, that the user gave; never that of
    the images.
    """
    size = in_file or hints.image_size
    if size is None:
        raise CalibrationError("does not say the image size", file=path, remedy=SIZE_REMEDY)
    values = numbers(path, "image size", size, 2)
    if not all(value > 0 and value == int(value) for value in values):
        raise CalibrationError(
            f"the image size must be two positive whole numbers, not {list(size)}", file=path
        )
    return int(values[0]), int(values[1])


def one_size(path: Path, sizes: Sequence[Any], hints: Hints) -> tuple[int, int]:
    """The image size that both eyes have; `sizes` as the file gives them."""
    both = [size_of(path, size, hints) for size in sizes]
    if both[0] != both[1]:
        raise CalibrationError(
            f"the left eye has images of {both[0]} px, the right one of {both[1]}", file=path
        )
    return both[0]


def raw_only(path: Path, hints: Hints) -> None:
    """Refuse the wish for rectified images from a format that describes raw ones."""
    if hints.images == "rectified":
        raise CalibrationError("describes raw images, not rectified ones", file=path)


def parse_json(path: Path, text: str) -> dict[str, Any]:
    """The object in a JSON text."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise CalibrationError(f"is not valid JSON: {fault}", file=path) from None
    if not isinstance(data, dict):
        raise CalibrationError(f"must hold an object, not {type(data).__name__}", file=path)
    return data


def section(path: Path, data: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The mapping under a key."""
    value = data.get(key)
    if not isinstance(value, dict):
        raise CalibrationError("must be a mapping", file=path, key=key)
    return value


def numbers(path: Path, key: str, values: Any, count: int | None = None) -> F64:
    """A flat list of finite numbers, of a certain length if one is given."""
    try:
        array = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"must be numbers, not {values!r:.80}", file=path, key=key) from None
    if not np.isfinite(array).all():
        raise CalibrationError(
            f"must be finite numbers, not {array.tolist()!r:.80}", file=path, key=key
        )
    if count is not None and len(array) != count:
        raise CalibrationError(f"must have {count} numbers, not {len(array)}", file=path, key=key)
    return array


def rigid_transform(path: Path, key: str, value: Any) -> F64:
    """A (4, 4) transform from its 16 numbers."""
    T = numbers(path, key, value, 16).reshape(4, 4)
    if fault := rotation_fault(T[:3, :3]):
        raise CalibrationError(f"the rotation {fault}", file=path, key=key)
    if not np.array_equal(T[3], (0, 0, 0, 1)):
        raise CalibrationError(
            f"the last row must be [0, 0, 0, 1], not {T[3].tolist()}", file=path, key=key
        )
    return T


def two_eyes(path: Path, present: Collection[int], hints: Hints) -> tuple[int, int]:
    """Numbers of the left and the right camera: those that the user gave, else the only two."""
    listing = ", ".join(map(str, sorted(present))) or "none"
    if hints.eyes is None and len(present) != 2:
        remedy = "Say which are left and right with --eyes L,R"
        raise CalibrationError(f"holds the cameras {listing}", file=path, remedy=remedy)
    left, right = hints.eyes or sorted(present)
    for index in (left, right):
        if index not in present:
            raise CalibrationError(f"has no camera {index}, only {listing}", file=path)
    return left, right


def other_eye(path: Path, pairs: Sequence[tuple[str, str]]) -> tuple[Path, Path]:
    """The two files of a format that keeps one an eye (or a half), from the name of either.

    Parameters
    ----------
    pairs
        Words of which one stands in the name of the first file and the other in that of the second.
    """
    for first, second in pairs:
        if first in path.name:
            return path, path.with_name(path.name.replace(first, second))
        if second in path.name:
            return path.with_name(path.name.replace(second, first)), path
    words = " or ".join(word for pair in pairs for word in pair)
    raise CalibrationError(
        f"is one file of two, and its name has no {words} to find the other by", file=path
    )


def in_metres(path: Path, shift: F64, hints: Hints) -> F64:
    """A translation (3,) [m] from a format that does not say its unit.

    Raises
    ------
    CalibrationError
        When no unit is given and metres are unlikely.
    """
    length = float(np.linalg.norm(shift))
    if hints.unit_m is None and length > LONGEST_UNSAID_M:
        problem = f"a baseline of {length:g}; {other_units(length)}, or --unit m"
        raise CalibrationError(problem, file=path, key="translation")
    return shift * (hints.unit_m or 1.0)


def without_tail(coefficients: Iterable[float], keep: int) -> tuple[float, ...]:
    """Distortion coefficients without the zeros behind the first `keep` and those in use."""
    values = [float(value) for value in coefficients]
    used = max((i + 1 for i, value in enumerate(values) if value), default=0)
    if len(values) <= keep:
        return tuple(values)
    count = next((n for n in COEFFICIENTS["pinhole"] if n >= max(used, keep)), used)
    return tuple([*values, *[0.0] * len(values)][:count])


def tell_unread(path: Path, entries: Mapping[str, Any], what: str = "") -> None:
    """Say which entries of a file were not read; refuse those that look like part of a lens model
    and are not zero.

    Parameters
    ----------
    entries
        By name, without those that were read or are known to mean nothing here.

    Raises
    ------
    CalibrationError
        A lens that is dropped makes a distorted eye an ideal one.
    """
    # A key of YAML may be a number.
    unread = [str(key) for key, value in entries.items() if _counts(value)]
    lens = [
        key
        for key in unread
        if _LENS_WORDS.search(key.lower()) and not _NO_MODEL.search(key.lower())
    ]
    if lens:
        problem = f"{what}{', '.join(lens)}: looks like part of a lens model and is not known here"
        remedy = (
            "Rename it (see docs/calibration.md for the names), or leave it out if it means nothing"
        )
        raise CalibrationError(problem, file=path, remedy=remedy)
    if unread:
        _log.warning("%s: %sentries not understood: %s", path, what, ", ".join(unread))


def _counts(value: Any) -> bool:
    """Whether an entry holds anything but zeros and nothing."""
    if isinstance(value, Mapping):
        return any(_counts(part) for part in value.values())
    if isinstance(value, list | tuple | np.ndarray):
        return any(_counts(part) for part in value)
    with contextlib.suppress(ValueError):
        return bool(float(value)) if isinstance(value, str) else bool(value)
    return bool(value)
