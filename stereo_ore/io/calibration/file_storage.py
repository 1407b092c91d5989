"""OpenCV's FileStorage as YAML, XML or JSON, with matrices as numbers or base64.

``cv2.FileStorage`` itself may abort the process on a damaged file.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.yaml_io import parse_yaml

_BASE64_HEADER = 24
"""Bytes before the numbers: how many of which type, as "9d", then blanks."""

_TYPES = {"u": "<u1", "c": "<i1", "w": "<u2", "s": "<i2", "i": "<i4", "f": "<f4", "d": "<f8"}


def parse_storage(path: Path, text: str) -> dict[str, Any]:
    """The entries of a storage; a matrix is the flat list of its numbers.

    Raises
    ------
    CalibrationError
        When the text is none, or a base64 matrix is damaged.
    """
    entries = _parse(path, text.lstrip("\ufeff \n"))
    return {str(key): _matrix(path, str(key), value) for key, value in entries.items()}


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        if text.startswith("<"):
            return _parse_xml(text)
        if text.startswith("{"):
            return dict(json.loads(text))
    except (ElementTree.ParseError, ValueError, TypeError, RecursionError) as fault:
        raise CalibrationError(f"is not a valid OpenCV FileStorage: {fault}", file=path) from None
    return parse_yaml(plain_yaml(text), path, CalibrationError, aliases=True)


def plain_yaml(text: str) -> str:
    """The YAML that OpenCV writes as other readers take it: no directive, no tags, a blank behind
    ``data:``.
    """
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    body = re.sub(r"!!(opencv-(nd-)?matrix|binary)", "", body)
    return re.sub(r"^([ \t]*[\w.]+):(?=\[)", r"\1: ", body, flags=re.MULTILINE)


def _parse_xml(text: str) -> dict[str, Any]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("document types and entities are not read")
    entries = dict[str, Any]()
    for entry in ElementTree.fromstring(text):
        data = entry.find("data")
        part = entry if data is None else data
        words = (part.text or "").split()
        entries[entry.tag] = "".join(words) if part.get("type_id") == "binary" else words
        if data is not None and part.get("type_id") == "binary":
            entries[entry.tag] = {"data": "".join(words)}
        elif data is None and len(words) == 1 and entry.get("type_id") is None:
            entries[entry.tag] = words[0]
    return entries


def _matrix(path: Path, key: str, value: Any) -> Any:
    data = value.get("data", value) if isinstance(value, dict) else value
    if isinstance(value, dict) and isinstance(data, str):
        return _from_base64(path, key, data.removeprefix("$base64$"))
    return data


def _from_base64(path: Path, key: str, text: str) -> Any:
    """The numbers of a matrix written with ``FILE_STORAGE_BASE64``: a header that names the type,
    then their bytes.
    """
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
        kind = re.fullmatch(r"\d*([ucwsifd])", data[:_BASE64_HEADER].decode("ascii").strip())
        if kind is None:
            raise ValueError("its header names no single type")
        return np.frombuffer(data[_BASE64_HEADER:], _TYPES[kind[1]]).astype(np.float64)
    except (binascii.Error, ValueError) as fault:
        remedy = "Write it again without FILE_STORAGE_BASE64"
        raise CalibrationError(
            f"is no matrix in base64: {fault}", file=path, key=key, remedy=remedy
        ) from None
