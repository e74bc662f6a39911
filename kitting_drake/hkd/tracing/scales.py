"""Finds the plane of a photo from a ruler, a disc or a ChArUco board of known size."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tracing.photo_file import ASSUMED_FOCAL_35MM, Photo
from kitting_drake.hkd.tracing.plane_view import (
    PlaneView,
    focal_of_height,
    focal_of_homography,
    view_of,
)
from kitting_drake.hkd.tracing.sheet_plane import GroundPlane

Array = NDArray[np.float64]

_COIN_MM = 2.0
"""The assumed thickness of a coin or disc, in mm."""
_MOST_TILT = math.radians(10)
"""The largest tilt of a circle, in radians, at which it is still found as a disc."""
_MARGIN_MM = 3.0
_LEAST_CORNERS = 6
_SMALL_SIDE = 1200


@dataclass(frozen=True)
class Scale:
    """An object of known size in the photo, given by `points`, `disc_mm` or `board`."""

    points: tuple[float, float, float, float] | None = None
    """Two points u1, v1, u2, v2 of the photo, in pixels, for instance on a ruler."""
    length_mm: float = 0.0
    """The distance between the two points, in mm."""
    disc_mm: float | None = None
    """The diameter of a disc or coin, in mm."""
    board: tuple[int, int, float, float] | None = None
    """Columns, rows, and the sides of a square and a marker of a ChArUco board, in mm."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the dictionary of the board's markers."""


def plane_of_scale(cv2: Any, photo: Photo, scale: Scale, camera_mm: float | None) -> GroundPlane:
    """Finds the plane from an object of known size.

    With two points or a disc, the photo must be taken from straight above.

    Args:
        cv2: OpenCV.
        photo: the photo.
        scale: the object of known size.
        camera_mm: the camera's height above the plane in mm; None: computed from the focal length.

    Raises:
        UserError: the object is not visible, or there are several, or a flag has a wrong value.
    """
    if scale.board is not None:
        return _by_board(cv2, photo, scale, camera_mm)
    if scale.disc_mm is not None:
        center, radius = _find_disc(cv2, photo)
        px_per_mm = 2 * radius / scale.disc_mm
        focal, told = _focal(photo, px_per_mm, camera_mm)
        # The disc's rim is closer to the camera than the plane is, by the disc's thickness.
        camera = focal / px_per_mm + _COIN_MM
        px_per_mm = focal / camera
        note = f"a disc of {scale.disc_mm:g} mm, {_COIN_MM:g} mm high"
        angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        ring = center + 1.12 * radius * np.c_[np.cos(angles), np.sin(angles)]
        return _straight_down(photo, px_per_mm, focal, [note, told], ring)
    assert scale.points is not None
    u1, v1, u2, v2 = scale.points
    distance = math.hypot(u2 - u1, v2 - v1)
    if distance < 20 or not 1 <= scale.length_mm <= 5000:
        raise UserError(
            f"the points of --scale_px are {distance:.0f} pixels apart, and --scale_mm is "
            f"{scale.length_mm:g}: give two points at least 20 pixels apart, and their distance, 1 "
            "to 5000 mm"
        )
    px_per_mm = distance / scale.length_mm
    focal, told = _focal(photo, px_per_mm, camera_mm)
    note = f"{px_per_mm:.2f} pixels per mm, from two points"
    return _straight_down(photo, px_per_mm, focal, [note, told], None)


def _focal(photo: Photo, px_per_mm: float, camera_mm: float | None) -> tuple[float, str]:
    """Returns the focal length in pixels, and a note on its source."""
    if camera_mm is not None:
        return px_per_mm * camera_mm, f"the camera is {camera_mm:g} mm above the ground, as given"
    equivalent = photo.focal_35mm or ASSUMED_FOCAL_35MM
    told = (
        "from the photo's EXIF data" if photo.focal_35mm else "assumed: the photo does not state it"
    )
    note = f"focal length {equivalent:.0f} mm (35 mm equivalent), {told}"
    return photo.focal_px(equivalent), note


def _straight_down(
    photo: Photo, px_per_mm: float, focal: float, notes: list[str], hidden_px: Array | None
) -> GroundPlane:
    """Returns the plane as seen from straight above; the photo's lower left corner is the
    origin."""
    width, height = photo.size
    homography = np.array([[px_per_mm, 0, -0.5], [0, -px_per_mm, height - 0.5], [0, 0, 1.0]])
    view = PlaneView(homography, focal, np.append(_center(photo, px_per_mm), focal / px_per_mm), 0)
    notes = [*notes, "the photo is assumed to be taken from straight above"]
    hidden = () if hidden_px is None else (view.to_plane(hidden_px),)
    high = np.array([width, height]) / px_per_mm
    return GroundPlane(view, photo.pixels, np.zeros(2), high, None, hidden, notes)


def _center(photo: Photo, px_per_mm: float) -> Array:
    return np.array(photo.size) / px_per_mm / 2


def _find_disc(cv2: Any, photo: Photo) -> tuple[Array, float]:
    """Finds the centre (2,) and the radius of the disc in the photo, in pixels."""
    factor = min(1.0, _SMALL_SIDE / max(photo.size))
    small = cv2.resize(photo.pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(cv2.GaussianBlur(small, (0, 0), 1.2), cv2.COLOR_RGB2LAB)
    found: list[tuple[float, Array, float]] = []
    for channel in range(3):
        levels = np.percentile(lab[..., channel], (3, 10, 25, 50, 75, 90, 97))
        otsu, _ = cv2.threshold(lab[..., channel], 0, 255, cv2.THRESH_OTSU)
        for level in (otsu, *levels):
            mask = (lab[..., channel] > level).astype(np.uint8)
            for part in (mask, 1 - mask):
                contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
                found += [disc for c in contours if (disc := _disc_of(cv2, c)) is not None]
    distinct: list[tuple[float, Array, float]] = []
    for disc in sorted(found, key=lambda disc: disc[0]):
        if all(np.linalg.norm(disc[1] - other[1]) > disc[2] for other in distinct):
            distinct.append(disc)
    if not distinct:
        raise UserError(
            f"{photo.path}: no disc is visible: lay the coin apart from the tools, on plain "
            "ground, and take the photo from straight above"
        )
    if len(distinct) > 1:
        raise UserError(
            f"{photo.path}: {len(distinct)} round objects are visible: show only one disc, or use "
            "--scale_px"
        )
    _, center, radius = distinct[0]
    return _refined_disc(cv2, photo, (center + 0.5) / factor - 0.5, radius / factor)


def _disc_of(cv2: Any, contour: Any) -> tuple[float, Array, float] | None:
    """Fits a circle to a contour; returns its (misfit, centre, radius), or None if the contour is
    not a circle."""
    area = cv2.contourArea(contour)
    if len(contour) < 40 or area < 400:
        return None
    center, axes, _ = cv2.fitEllipse(contour)
    ratio = min(axes) / max(axes)
    misfit = abs(area / (math.pi * axes[0] * axes[1] / 4) - 1)
    hull = cv2.contourArea(cv2.convexHull(contour))
    if ratio < math.cos(_MOST_TILT) or misfit > 0.03 or hull > 1.03 * area:
        return None
    return misfit + 1 - ratio, np.array(center), float(axes[0] + axes[1]) / 4


def _refined_disc(cv2: Any, photo: Photo, center: Array, radius: float) -> tuple[Array, float]:
    """Refines a circle: fits it to the steepest changes of lightness along rays from its centre."""
    gray = cv2.GaussianBlur(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    angles = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    rays = np.c_[np.cos(angles), np.sin(angles)]
    steps = np.linspace(0.9 * radius, 1.1 * radius, max(40, int(0.4 * radius)))
    grid = (center + steps[None, :, None] * rays[:, None]).astype(np.float32)
    profile = cv2.remap(gray, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR).astype(float)
    at = steps[np.argmax(np.abs(np.gradient(profile, axis=1)), axis=1)]
    near = np.abs(at - np.median(at)) < 0.04 * radius
    points = center + at[near, None] * rays[near]
    design = np.c_[2 * points, np.ones(len(points))]
    x, y, c = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    return np.array([x, y]), math.sqrt(c + x * x + y * y)


def _by_board(cv2: Any, photo: Photo, scale: Scale, camera_mm: float | None) -> GroundPlane:
    assert scale.board is not None
    columns, rows, square, marker = scale.board
    dictionary = getattr(cv2.aruco, scale.dictionary.upper(), None)
    if dictionary is None:
        raise UserError(
            f"--dictionary {scale.dictionary} is not a dictionary of OpenCV, such as DICT_4X4_50"
        )
    try:
        board = cv2.aruco.CharucoBoard(
            (columns, rows), square, marker, cv2.aruco.getPredefinedDictionary(dictionary)
        )
    except (cv2.error, SystemError) as error:
        raise UserError(
            f"--board: OpenCV cannot make a board of {columns} x {rows} squares of {square:g} mm "
            f"with markers of {marker:g} mm: check these numbers"
        ) from error
    gray = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
    if ids is None or len(ids) < _LEAST_CORNERS:
        seen = 0 if ids is None else len(ids)
        raise UserError(
            f"{photo.path}: {seen} corners of the board are visible, fewer than {_LEAST_CORNERS}: "
            "show the whole board, and check --board and --dictionary"
        )
    points = board.getChessboardCorners()[ids.ravel(), :2].astype(float)
    # OpenCV's frame of the board has y pointing down. Flip it, so that y points up.
    points[:, 1] = rows * square - points[:, 1]
    pixels = corners.reshape(-1, 2).astype(float)
    homography, _ = cv2.findHomography(points, pixels)
    if photo.focal_35mm:
        focal = photo.focal_px(photo.focal_35mm)
        told = (
            f"focal length {photo.focal_35mm:g} mm (35 mm equivalent), from the photo's EXIF data"
        )
    else:
        known = focal_of_homography(homography, photo.center)
        focal = known or photo.focal_px(ASSUMED_FOCAL_35MM)
        told = f"focal length {focal / photo.focal_px(1.0):.0f} mm (35 mm equivalent), " + (
            "from the board's perspective" if known else "assumed: the photo does not state it"
        )
    if camera_mm is not None:
        focal = focal_of_height(homography, camera_mm, focal, photo.center)
        told = f"the camera is {camera_mm:g} mm above the ground, as given"
    view = view_of(homography, focal, photo.center)
    border = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [columns * square, rows * square]
    outward = np.sign(border - border.mean(axis=0)) * _MARGIN_MM
    frame = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (np.array(photo.size) - 1.0)
    reach = view.to_plane(frame)
    low, high = reach.min(axis=0), reach.max(axis=0)
    notes = [f"a board of {columns} x {rows} squares of {square:g} mm", told]
    return GroundPlane(view, photo.pixels, low, high, None, (border + outward,), notes)
