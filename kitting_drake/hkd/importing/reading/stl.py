"""Reads STL files, and tolerates common deviations from the format.

A binary file may have bytes after its triangles, or a count of 0. A text file may lack `endsolid`,
and the name of its solid may be any words.
"""

import re
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

_HEADER = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NUMBER = rb"[-+.,\w]+"
_VERTEX = re.compile(
    rb"^\s*vertex\s+(" + _NUMBER + rb")\s+(" + _NUMBER + rb")\s+(" + _NUMBER + rb")\s*$",
    re.IGNORECASE | re.MULTILINE,
)
_FACET = re.compile(rb"^\s*facet\b", re.IGNORECASE | re.MULTILINE)


def read_stl(path: Path) -> NDArray[np.float64]:
    """Reads the triangles (n, 3, 3) of a binary or text STL, in the file's units.

    Raises:
        UserError: the file is cut short, or is not STL.
    """
    data = path.read_bytes()
    if _is_text(data):
        return _text_triangles(data, path)
    if len(data) < _HEADER:
        raise UserError(f"{path} is too short for an STL: copy or export it again")
    (count,) = struct.unpack_from("<I", data, _HEADER - 4)
    present, rest = divmod(len(data) - _HEADER, _TRIANGLE.itemsize)
    # Programs that write triangles one by one may leave a count of 0 or of 0xffffffff.
    if count in (0, 2**32 - 1) and present and not rest:
        count = present
    if count > present:
        raise UserError(
            f"{path} is cut short or not an STL: its header counts {count} triangles, and "
            f"{count - present} of them are missing; copy or export it again"
        )
    triangles = np.frombuffer(data, _TRIANGLE, count, _HEADER)
    return np.asarray(triangles["corners"], dtype=np.float64)


def _is_text(data: bytes) -> bool:
    """Whether an STL is text.

    The first word does not decide it, because a binary file may also start with `solid`. But a
    binary file has a zero byte, because its count of triangles is below 2**24; text has none.
    """
    return b"\0" not in data[:_HEADER] and re.search(rb"vertex\s", data, re.IGNORECASE) is not None


def _text_triangles(data: bytes, path: Path) -> NDArray[np.float64]:
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # Match whole lines, because the line with the name of a solid may hold any words.
    facets = len(_FACET.findall(data))
    corners = _VERTEX.findall(data)
    if len(corners) != 3 * facets:
        raise UserError(
            f"{path} is cut short or damaged: its {facets} triangles need {3 * facets} corners, "
            f"and {abs(3 * facets - len(corners))} are "
            f"{'missing' if len(corners) < 3 * facets else 'too many'}: export it again"
        )
    try:
        # Some programs write decimal commas, depending on the country.
        flat = [float(number.replace(b",", b".")) for corner in corners for number in corner]
    except ValueError as error:
        raise UserError(
            f"{path} is not valid STL: a corner is not three numbers; export it again"
        ) from error
    return np.array(flat).reshape(-1, 3, 3)
