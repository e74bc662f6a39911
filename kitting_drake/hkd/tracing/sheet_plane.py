"""Finds the plane of a photo from a sheet of paper of known size."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tracing.photo_file import ASSUMED_FOCAL_35MM, Photo
from kitting_drake.hkd.tracing.plane_view import (
    PlaneView,
    aspect_of_quad,
    focal_of_height,
    focal_of_homography,
    square_to,
    view_of,
)
from kitting_drake.hkd.tracing.sheet_finder import SheetQuad, find_quads

Array = NDArray[np.float64]

SHEETS = {"a4": (297.0, 210.0), "letter": (279.4, 215.9)}
"""The sides of sheets of paper in mm, the longer side first."""
_ASPECT_ERROR = 0.025
"""A quadrilateral may be an A4 or Letter sheet if its `_aspect_error` is less than this."""
_GIVEN_ASPECT_ERROR = 0.06
"""The largest accepted `_aspect_error` of a sheet whose size the user gives."""
_FOCALS_35MM = (22.0, 24.0, 26.0, 28.0, 31.0)
"""Typical 35 mm equivalent focal lengths of phones, for photos that do not state theirs."""
_FOCAL_RANGE_35MM = (18.0, 90.0)
_MARGIN_MM = 8.0
_BOW_MM = 0.3
"""The bow of a sheet's edges, in mm, below which the lens distortion is not corrected."""


@dataclass(frozen=True)
class GroundPlane:
    """The plane that the tools lie on, as seen in a photo."""

    view: PlaneView
    pixels: Any
    """The photo's pixels (rows, columns, 3), without the lens distortion."""
    low: Array
    """The lower left corner (2,) of the part of the plane to trace, in mm."""
    high: Array
    """The upper right corner (2,) of the part of the plane to trace, in mm."""
    sheet: Array | None
    """The sides (2,) of the sheet in mm, if there is one; its lower left corner is the origin."""
    hidden: tuple[Array, ...]
    """Polygons (n, 2) in mm, around a disc or a board, in which no tools are sought."""
    notes: list[str]
    blur_mm: float = 0.0
    """The width of the blur of the sheet's edges in mm; 0 if unknown."""


def plane_of_sheet(
    cv2: Any,
    photo: Photo,
    size: tuple[float, float] | None,
    corners: Array | None = None,
    camera_mm: float | None = None,
) -> GroundPlane:
    """Finds the sheet in a photo, and the camera's position above it.

    Args:
        cv2: OpenCV.
        photo: the photo.
        size: the sheet's sides, in mm. None: A4 if `corners` is given; else A4 or Letter, by the
            ratio of the sides in the photo.
        corners: (4, 2) the sheet's corners in pixels; None: they are found automatically.
        camera_mm: the camera's height above the sheet, in mm; None: computed from the focal length.

    Raises:
        UserError: no sheet is found, or it may be either A4 or Letter.
    """
    if corners is None:
        quad, size = _choose(photo, find_quads(cv2, photo.pixels), size)
        corners = quad.corners
    else:
        quad = None
        size = size or SHEETS["a4"]
    notes: list[str] = []
    pixels = photo.pixels
    homography, sides = _oriented(photo, corners, size)
    focal, told = _focal(photo, homography, camera_mm)
    if quad is not None:
        lens, note = _lens_of_edges(cv2, quad, sides, focal, photo)
        if note:
            notes.append(note)
        if lens:
            K = np.array([[focal, 0, photo.center[0]], [0, focal, photo.center[1]], [0, 0, 1.0]])
            pixels = cv2.undistort(pixels, K, np.array([lens, 0, 0, 0]))
            flat = cv2.undistortPoints(
                corners.reshape(-1, 1, 2), K, np.array([lens, 0, 0, 0]), P=K
            ).reshape(4, 2)
            again = [q for q in find_quads(cv2, pixels) if np.abs(q.corners - flat).max() < 30]
            homography, sides = _oriented(photo, again[0].corners if again else flat, size)
    view = view_of(homography, focal, photo.center)
    notes = [f"a sheet of {sides[0]:g} x {sides[1]:g} mm", told, *notes]
    blur = quad.width_px / view.px_per_mm(sides / 2) if quad else 0.0
    return GroundPlane(
        view, pixels, np.full(2, -_MARGIN_MM), sides + _MARGIN_MM, sides, (), notes, blur
    )


def _oriented(photo: Photo, corners: Array, size: tuple[float, float]) -> tuple[Array, Array]:
    """Returns the homography from the sheet's frame to pixels, and the sheet's sides along x and
    y."""
    right = [corners[(i + 1) % 4] - corners[i] for i in range(4)]
    start = int(np.argmax([side[0] / np.linalg.norm(side) for side in right]))
    corners = np.roll(corners, -start, axis=0)
    focal = photo.focal_px(photo.focal_35mm or ASSUMED_FOCAL_35MM)
    long, short = max(size), min(size)
    wide = aspect_of_quad(corners, focal, photo.center) > 1
    sides = np.array([long, short] if wide else [short, long])
    return square_to(corners) @ np.diag([1 / sides[0], 1 / sides[1], 1]), sides


def _choose(
    photo: Photo, quads: list[SheetQuad], size: tuple[float, float] | None
) -> tuple[SheetQuad, tuple[float, float]]:
    """Returns the largest quadrilateral with the proportions of a sheet, and the sheet's size."""
    if not quads:
        raise UserError(
            f"{photo.path}: no sheet of paper is found: lay the tools on a whole A4 or Letter "
            "sheet that stands out from the desk, or give its corners with --points"
        )
    allowed = _ASPECT_ERROR if size is None else _GIVEN_ASPECT_ERROR
    sizes = list(SHEETS.values()) if size is None else [size]
    for quad in quads:
        errors = [_aspect_error(photo, quad.corners, sides) for sides in sizes]
        fitting = [k for k, error in enumerate(errors) if error < allowed]
        if len(fitting) > 1:
            raise UserError(
                f"{photo.path}: the sheet may be A4 or Letter: say which with --sheet a4 or "
                "--sheet letter"
            )
        if fitting:
            return quad, sizes[fitting[0]]
    focal = photo.focal_px(photo.focal_35mm or ASSUMED_FOCAL_35MM)
    ratio = aspect_of_quad(quads[0].corners, focal, photo.center)
    ratio = max(ratio, 1 / ratio)
    wanted = "A4 (1.414) or Letter (1.294)" if size is None else f"{max(size) / min(size):.3f}"
    raise UserError(
        f"{photo.path}: the ratio of the sides of the largest sheet found is {ratio:.3f}, not "
        f"{wanted}: show the whole sheet, flat, or give its size with --sheet LENGTH WIDTH"
    )


def _aspect_error(photo: Photo, corners: Array, size: tuple[float, float]) -> float:
    """Returns the difference of a sheet's aspect ratio in the photo from that of `size`.

    It is the absolute difference of the logarithms. If the focal length is not known, this is the
    smallest difference at any of `_FOCALS_35MM`.
    """
    focals = (photo.focal_35mm,) if photo.focal_35mm else _FOCALS_35MM
    wanted = math.log(max(size) / min(size))
    errors = []
    for focal in focals:
        ratio = aspect_of_quad(corners, photo.focal_px(focal), photo.center)
        errors.append(abs(abs(math.log(ratio)) - wanted))
    return min(errors)


def _focal(photo: Photo, homography: Array, camera_mm: float | None) -> tuple[float, str]:
    """Returns the focal length in pixels, and a note on its source."""
    if camera_mm is not None:
        start = photo.focal_px(ASSUMED_FOCAL_35MM)
        focal = focal_of_height(homography, camera_mm, start, photo.center)
        return focal, f"the camera is {camera_mm:g} mm above the sheet, as given"
    if photo.focal_35mm:
        text = (
            f"focal length {photo.focal_35mm:g} mm (35 mm equivalent), from the photo's EXIF data"
        )
        if photo.cropped:
            text += ", though the photo was cropped"
        return photo.focal_px(photo.focal_35mm), text
    focal_px = focal_of_homography(homography, photo.center)
    equivalent = focal_px / photo.focal_px(1.0) if focal_px else 0.0
    if focal_px and _FOCAL_RANGE_35MM[0] < equivalent < _FOCAL_RANGE_35MM[1]:
        return focal_px, (
            f"focal length {equivalent:.0f} mm (35 mm equivalent), from the sheet's perspective"
        )
    return photo.focal_px(ASSUMED_FOCAL_35MM), (
        f"focal length {ASSUMED_FOCAL_35MM:g} mm (35 mm equivalent) assumed: the photo does not "
        "state it"
    )


def _lens_of_edges(
    cv2: Any, quad: SheetQuad, sides: Array, focal: float, photo: Photo
) -> tuple[float, str]:
    """Finds the lens distortion that makes the sheet's edges straight.

    Returns:
        The coefficient k1 of the distortion, 0 if none is needed; and a note for the user, which
        may be empty.
    """
    mm_per_px = float(sides.sum() * 2) / sum(
        float(np.linalg.norm(quad.corners[i] - quad.corners[i - 1])) for i in range(4)
    )

    def bows(k1: float) -> Array:
        """Returns the sagitta (4,) of each edge in mm, after correction with k1."""
        result = []
        for points in quad.edges:
            p = (points - photo.center) / focal
            # Invert the distortion to first order, and refine the result once.
            r = (p**2).sum(axis=1, keepdims=True)
            q = p / (1 + k1 * r)
            q = p / (1 + k1 * (q**2).sum(axis=1, keepdims=True))
            along = q[-1] - q[0]
            along /= np.linalg.norm(along)
            s, t = (q - q[0]) @ along, (q - q[0]) @ np.array([-along[1], along[0]])
            s = 2 * (s - s.min()) / np.ptp(s) - 1
            result.append(np.polyfit(s, t, 2)[0] * focal * mm_per_px)
        return np.array(result)

    before = float(np.abs(bows(0)).max())
    if before < _BOW_MM:
        return 0.0, ""
    values = np.linspace(-0.3, 0.3, 241)
    cost = [float((bows(k) ** 2).sum()) for k in values]
    best = float(values[int(np.argmin(cost))])
    if min(cost) < 0.15 * cost[120] and abs(best) < 0.29:
        return best, f"lens distortion of {before:.1f} mm at the sheet's edges corrected"
    return 0.0, f"the sheet is not flat: its edges are bowed by {before:.1f} mm"
