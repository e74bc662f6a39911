"""Reads point clouds in PCL's format PCD, as text, binary, or compressed."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

_HEADER = ("FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "DATA")
_NEEDED = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA")
_UNMOVED = [0.0, 0, 0, 1, 0, 0, 0]
_LONGEST = 100
"""The largest number of lines of a header."""
_KINDS = {"F": "f", "U": "u", "I": "i"}


def read_pcd(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None, tuple[int, int]]:
    """Reads a point cloud.

    Returns:
        The points (n, 3) in the unit of the file; their colours (n, 3), or None; and the
        (width, height) of the grid in which the points are organised.

    Raises:
        UserError: the file is damaged, or its points are not in the camera's frame.
    """
    try:
        content = path.read_bytes()
        header, at = _read_header(content)
        table = _read_table(header, content[at:])
        viewpoint = [float(word) for word in header.get("VIEWPOINT", [])] or _UNMOVED
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, IndexError, struct.error, TypeError) as error:
        raise UserError(f"cannot read {path}: it is not a complete PCD file") from error
    missing = [axis for axis in "xyz" if axis not in table]
    if missing:
        raise UserError(f"{path} has no field {missing[0]}: save points with x, y and z")
    if len(viewpoint) != 7 or not np.allclose(viewpoint, _UNMOVED):
        raise UserError(
            f"{path} has a VIEWPOINT other than 0 0 0 1 0 0 0: save the points in the frame of "
            "the camera"
        )
    points = np.stack([table[axis] for axis in "xyz"], axis=-1).astype(float)
    packed = next((table[name] for name in ("rgb", "rgba") if name in table), None)
    # Some programs write all colours as zero in text files; ignore such colours.
    colors = _unpacked(packed) if packed is not None and packed.any() else None
    return points, colors, (int(header["WIDTH"][0]), int(header["HEIGHT"][0]))


def _read_header(content: bytes) -> tuple[dict[str, list[str]], int]:
    """Returns the header's words by key, and the position at which the data begin."""
    header: dict[str, list[str]] = {}
    at = 0
    for _ in range(_LONGEST):
        end = content.index(b"\n", at)
        words = content[at:end].decode("ascii").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
            if words[0] == "DATA":
                break
    if not set(_NEEDED) <= set(header):
        raise ValueError("the header is not complete")
    return header, at


def _read_table(header: dict[str, list[str]], data: bytes) -> dict[str, NDArray[Any]]:
    """Returns each field's values (n,) for the n points, by the field's name.

    If a field has several numbers for each point, only the first one is returned.
    """
    names = header["FIELDS"]
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(names))]
    kinds = [
        np.dtype(f"<{_KINDS[kind]}{size}")
        for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)
    ]
    points = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    # Padding fields are all called _, so there may be several of this name.
    columns = [(f"{name}{i}" if name == "_" else name) for i, name in enumerate(names)]
    rows = np.dtype(
        [(name, kind, (n,)) for name, kind, n in zip(columns, kinds, counts, strict=True)]
    )
    form = header["DATA"][0]
    if form == "ascii":
        words = np.array(data.split()).reshape(points, sum(counts))
        starts = np.cumsum([0, *counts[:-1]])
        return {
            name: words[:, at].astype(float).astype(kind)
            for name, kind, at in zip(columns, kinds, starts, strict=True)
        }
    if form == "binary":
        table = np.frombuffer(data, rows, count=points)
        return {name: table[name][:, 0] for name in columns}
    if form != "binary_compressed":
        raise ValueError(form)
    packed, size = struct.unpack("<II", data[:8])
    if len(data) < 8 + packed or size != rows.itemsize * points:
        raise ValueError("the data are not complete")
    plain, at, result = _decompressed(data[8 : 8 + packed], size), 0, {}
    # In compressed data, all values of one field precede those of the next.
    for name, kind, n in zip(columns, kinds, counts, strict=True):
        result[name] = np.frombuffer(plain, kind, points * n, at).reshape(points, n)[:, 0]
        at += kind.itemsize * points * n
    return result


def _decompressed(data: bytes, size: int) -> bytes:
    """Decompresses data by LZF to a given size."""
    result, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            result += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        start = len(result) - ((control & 31) << 8) - data[at] - 1
        at += 1
        length += 2
        if start < 0:
            raise ValueError("the data are damaged")
        while length > 0:
            # The source may overlap the bytes that this copy appends, so copy in pieces.
            piece = result[start : start + length]
            result += piece
            start, length = start + len(piece), length - len(piece)
    if len(result) != size:
        raise ValueError("the data are not complete")
    return bytes(result)


def _unpacked(packed: NDArray[Any]) -> NDArray[np.uint8]:
    """Unpacks colours (n, 3) from 0x00RRGGBB, which PCL also stores as the bits of a float."""
    bits = packed.view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
    shifted = np.stack([bits >> 16, bits >> 8, bits], axis=-1)
    return (shifted & 0xFF).astype(np.uint8)
