"""Boards of markers: their layout, their pose in the base frame, and their corners in images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.real_camera.calibrations.field_checks import check_fields
from kitting_drake.real_camera.calibrations.layouts import get
from kitting_drake.real_camera.calibrations.pose_values import assembled, pose_of_value
from kitting_drake.real_camera.calibrations.yaml_values import (
    matrix,
    number,
    read_yaml,
    whole_number,
)

Array = NDArray[np.float64]

_TYPES = ("charuco", "apriltag", "aruco")
_FIELDS = (
    *("type", "columns", "rows", "square", "marker", "gap", "dictionary", "first_id"),
    *("legacy_pattern", "pose", "touch", "thickness"),
)
_CORNERS = ("bottom_left", "bottom_right", "top_left")
_NEEDED = 12
"""A pose needs at least this many corners. A board with fewer corners must show all of them."""
_SHIFT = 0.42
"""The approximate shift of corners by OpenCV's refinement of AprilTags, in pixels."""
_LEVEL = math.radians(3)
"""The largest accepted tilt, in radians, of a board on the table."""
_TOUCHED = 0.003
"""The largest accepted error of the distance between touched corners, in metres."""
_LARGEST = 2.0
"""If a board is larger than this, in metres, its sizes are probably in millimetres."""


@dataclass(frozen=True)
class Board:
    """A board of markers that lies flat on the table.

    The origin of the board's frame M is the lower left corner of the pattern, as seen from above
    with the print upright. Its x points right, its y up along the print, and its z out of the
    print.
    """

    path: Path
    """The file with the board's description, for error messages."""
    pattern: Any
    """OpenCV's board."""
    size: tuple[float, float]
    """The size of the pattern along x and y, in metres."""
    is_chessboard: bool
    """Whether the board has chessboard corners (ChArUco) besides those of its markers."""
    count: int
    """The number of all corners."""
    X_BM: Array
    """The pose (4, 4) of the board's frame M in the base frame B."""
    thickness: float = 0.0
    """The height of the print above the table, in metres."""

    @property
    def table_height(self) -> float:
        """The height of the table under the board's middle, in the base frame, in metres."""
        middle = self.X_BM @ [self.size[0] / 2, self.size[1] / 2, 0, 1]
        return float(middle[2]) - self.thickness

    @property
    def tilt(self) -> float:
        """The angle between the board's z and the base's z, in radians."""
        return float(np.arccos(np.clip(self.X_BM[2, 2], -1, 1)))


@dataclass(frozen=True)
class SeenBoard:
    """The corners of a board that were found in an image."""

    points: Array
    """The corners (n, 3) in the board's frame, in metres."""
    pixels: Array
    """The columns and rows (n, 2) of the corners; pixel centres have whole numbers."""
    markers: int
    """The number of markers found."""


def read_board(path: Path) -> Board:
    """Reads the description of a board; docs/bench.md has an example.

    Raises:
        UserError: a field is missing or invalid. The message names the field.
        MachineError: OpenCV is missing.
    """
    content = read_yaml(path)
    check_fields(content, _FIELDS, str(path))
    kind = get(content, "type", str(path))
    if kind not in _TYPES:
        raise UserError(
            f"{path}: type must be charuco, apriltag or aruco, not {kind!r} (kalibr's aprilgrid "
            "cannot be read, because it has other borders)"
        )
    cv2 = _opencv()
    dictionary = _dictionary(cv2, content, path)
    columns, rows = (
        whole_number(get(content, key, str(path)), f"{path}: {key}") for key in ("columns", "rows")
    )
    marker = _length(content, "marker", path)
    held = len(dictionary.bytesList)
    first = int(number(content.get("first_id", 0), f"{path}: first_id"))
    needed = columns * rows // 2 if kind == "charuco" else first + columns * rows
    if not 0 <= first <= needed <= held:
        raise UserError(
            f"{path}: the board needs {needed} markers, but its dictionary has only {held}: use a "
            "larger dictionary"
        )
    try:
        if kind == "charuco":
            square = _length(content, "square", path)
            pattern = cv2.aruco.CharucoBoard((columns, rows), square, marker, dictionary)
            pattern.setLegacyPattern(content.get("legacy_pattern") is True)
            size = (columns * square, rows * square)
            count = (columns - 1) * (rows - 1) + 4 * len(pattern.getIds())
        else:
            gap = _length(content, "gap", path) if columns * rows > 1 else marker
            ids = np.arange(first, first + columns * rows, dtype=np.int32)
            pattern = cv2.aruco.GridBoard((columns, rows), marker, gap, dictionary, ids)
            size = (columns * (marker + gap) - gap, rows * (marker + gap) - gap)
            count = 4 * columns * rows
    except (cv2.error, SystemError) as error:
        raise UserError(
            f"{path}: OpenCV cannot make a board of {columns}x{rows} with these sizes: a marker "
            "must be smaller than a square"
        ) from error
    if max(size) > _LARGEST:
        raise UserError(f"{path}: the board would be {max(size):g} m long: give sizes in metres")
    thickness = number(content.get("thickness", 0.0), f"{path}: thickness")
    board = Board(
        path, pattern, size, kind == "charuco", count, _pose(content, size, path), thickness
    )
    if board.tilt > _LEVEL:
        raise UserError(
            f"{path}: the board's pose is tilted by {math.degrees(board.tilt):.1f} degrees: it "
            "must lie flat on the table, with the print and its z up"
        )
    return board


def find_corners(board: Board, image: NDArray[np.uint8], where: str) -> SeenBoard:
    """Finds the corners of a board in an image (height, width, 3).

    Raises:
        UserError: too few corners are visible. The message says how many.
    """
    cv2 = _opencv()
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found, strangers = _find_markers(cv2, board, gray)
    if strangers and not found:
        raise UserError(
            f"{where} shows the markers {', '.join(map(str, strangers[:6]))}, which are not on the "
            f"board of {board.path}: check dictionary, columns, rows and first_id"
        )
    ids = board.pattern.getIds().ravel().tolist()
    objects = dict(zip(ids, map(np.asarray, board.pattern.getObjPoints()), strict=False))
    points = [objects[key].reshape(-1, 3) for key in found]
    pixels = _centred(cv2, gray, list(found.values()))
    if board.is_chessboard:
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board.pattern).detectBoard(gray)
        if numbers is not None and len(numbers):
            points.append(board.pattern.getChessboardCorners()[numbers.ravel()])
            pixels.append(np.asarray(corners, float).reshape(-1, 2))
    total = sum(map(len, points))
    needed = min(_NEEDED, board.count)
    if total < needed:
        raise UserError(
            f"{where} shows {len(found)} of the board's {len(ids)} markers and {total} of its "
            f"{board.count} corners, but a pose needs {needed} corners: check the board's "
            "description, the light and the focus, and that the board is in view"
        )
    own = _in_own_frame(np.concatenate(points).astype(float), board.size[1])
    return SeenBoard(own, np.concatenate(pixels), len(found))


def _find_markers(cv2: Any, board: Board, gray: Any) -> tuple[dict[int, Array], list[int]]:
    """Returns the corners (4, 2) of the board's markers by number, and the numbers of other
    markers."""
    parameters = cv2.aruco.DetectorParameters()
    # The AprilTag refinement fits lines to the sides, so its corners err only a quarter as much as
    # those of other refinements.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(board.pattern.getDictionary(), parameters)
    corners, numbers, _ = detector.detectMarkers(gray)
    if numbers is None:
        return {}, []
    known = set(board.pattern.getIds().ravel().tolist())
    seen = {
        int(number): np.asarray(quad, float).reshape(4, 2)
        for number, quad in zip(numbers.ravel(), corners, strict=True)
    }
    ours = {number: quad for number, quad in seen.items() if number in known}
    return ours, sorted(set(seen) - known)


def _centred(cv2: Any, gray: Any, quads: list[Array]) -> list[Array]:
    """Corrects the corners (4, 2) of markers for the shift that their refinement causes.

    OpenCV's AprilTag refinement shifts all corners by about 0.4 pixels. Another refinement is
    noisier but has no such bias. The mean difference between the two is the exact shift.
    """
    if not quads:
        return []
    corners = np.concatenate(quads)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    start = (corners - _SHIFT).astype(np.float32).reshape(-1, 1, 2)
    others = cv2.cornerSubPix(gray, start, (3, 3), (-1, -1), criteria).reshape(-1, 2)
    shifts = corners - others
    near = np.abs(shifts - _SHIFT).max(axis=1) < 1
    shift = shifts[near].mean(axis=0) if near.any() else _SHIFT
    return [quad - shift for quad in quads]


def _in_own_frame(points: Array, height: float) -> Array:
    """Converts points (n, 3) from OpenCV's frame of a board to the frame M (see `Board`).

    The origin of OpenCV's frame is the top left corner. Its y points down and its z into the board.
    """
    return points * [1, -1, -1] + [0, height, 0]


def _opencv() -> Any:
    return import_extra("cv2", purpose="--calibrate", extra="camera")


def _dictionary(cv2: Any, content: dict[str, Any], path: Path) -> Any:
    default = "APRILTAG_36h11" if content["type"] == "apriltag" else None
    given = content.get("dictionary", default)
    if given is None:
        raise UserError(f"{path} lacks 'dictionary': give one, such as 5X5_100")
    wanted = str(given).upper().removeprefix("DICT_").replace("TAG36", "TAG_36")
    names = {name.upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
    name = names.get(f"DICT_{wanted}")
    if name is None:
        known = ", ".join(sorted(name.removeprefix("DICT_") for name in names.values()))
        raise UserError(f"{path}: there is no dictionary {given}: give one of {known}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _length(content: dict[str, Any], key: str, path: Path) -> float:
    value = number(get(content, key, str(path)), f"{path}: {key}")
    if value <= 0:
        raise UserError(f"{path}: {key} must be more than 0, in metres")
    return value


def _pose(content: dict[str, Any], size: tuple[float, float], path: Path) -> Array:
    """Returns the pose (4, 4) of the board in the base: the given one, or one computed from three
    corners that the robot touched."""
    if ("pose" in content) == ("touch" in content):
        raise UserError(
            f"{path} must have either 'pose' (of the board in the base frame) or 'touch' (the "
            f"positions of {', '.join(_CORNERS)}), not both"
        )
    if "pose" in content:
        return pose_of_value(content["pose"], f"{path}: pose").X
    touch = content["touch"]
    if not isinstance(touch, dict) or set(touch) != set(_CORNERS):
        raise UserError(f"{path}: touch must have {', '.join(_CORNERS)}, in metres")
    origin, right, top = (matrix(touch[key], 1, 3, f"{path}: touch.{key}")[0] for key in _CORNERS)
    width, height = np.linalg.norm(right - origin), np.linalg.norm(top - origin)
    skew = abs(math.hypot(*size) - np.linalg.norm(right - top))
    errors = (abs(width - size[0]), abs(height - size[1]), skew)
    if max(errors) > _TOUCHED:
        raise UserError(
            f"{path}: the touched corners are {1e3 * width:.1f} and {1e3 * height:.1f} mm apart, "
            f"but the pattern is {1e3 * size[0]:.1f} x {1e3 * size[1]:.1f} mm: touch the corners "
            "of the pattern, not of the paper, with the print upright"
        )
    x = (right - origin) / width
    z = np.cross(x, top - origin)
    z /= np.linalg.norm(z)
    return assembled(np.column_stack([x, np.cross(z, x), z]), origin)
