"""A photo's view of the plane that the tools lie on: rectification and the camera's position."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TELLING_TILT = math.radians(14)
"""The least tilt, in radians, at which a sheet's perspective determines the focal length well."""


@dataclass(frozen=True)
class PlaneView:
    """The map between the plane, in mm, and an undistorted photo, in pixels.

    The x and y axes of the plane's frame lie in the plane; z points to the camera's side.
    """

    homography: Array
    """The homography (3, 3) that maps points of the plane to pixels."""
    focal_px: float
    camera: Array
    """The camera's position (3,) in the plane's frame, in mm."""
    tilt: float
    """The angle between the camera's optical axis and the plane's normal, in radians."""

    def to_pixels(self, points: Array) -> Array:
        """Maps points (n, 2) of the plane in mm to pixels (n, 2)."""
        return mapped(self.homography, points)

    def to_plane(self, pixels: Array) -> Array:
        """Maps pixels (n, 2) to points (n, 2) of the plane in mm."""
        return mapped(np.asarray(np.linalg.inv(self.homography), float), pixels)

    def px_per_mm(self, point: Array) -> float:
        """The photo's resolution at a point (2,) of the plane, in pixels per mm."""
        near = self.to_pixels(np.array([point, point + (1, 0), point + (0, 1)]))
        return float(math.sqrt(abs(np.linalg.det(near[1:] - near[0]))))


def mapped(homography: Array, points: Array) -> Array:
    """Maps points (n, 2) by a homography (3, 3)."""
    image = np.c_[np.asarray(points, float), np.ones(len(points))] @ homography.T
    return image[:, :2] / image[:, 2:]


def view_of(homography: Array, focal_px: float, center: Array) -> PlaneView:
    """Returns the view of a plane, with the camera's pose computed from a homography.

    Args:
        homography: the homography (3, 3) from the plane in mm to pixels.
        focal_px: the focal length in pixels.
        center: (2,) the principal point in pixels.
    """
    rotation, shift = _pose(homography, focal_px, center)
    camera = -rotation.T @ shift
    return PlaneView(homography, focal_px, camera, float(math.acos(min(1, -rotation[2, 2]))))


def _pose(homography: Array, focal_px: float, center: Array) -> tuple[Array, Array]:
    scaled = _centred(homography, center) / np.array([[focal_px], [focal_px], [1.0]])
    scaled /= math.sqrt(np.linalg.norm(scaled[:, 0]) * np.linalg.norm(scaled[:, 1]))
    if scaled[2, 2] < 0:
        scaled = -scaled
    first, second, shift = scaled.T
    U, _, V = np.linalg.svd(np.column_stack([first, second, np.cross(first, second)]))
    rotation = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
    return rotation, shift


def _centred(homography: Array, center: Array) -> Array:
    return np.array([[1, 0, -center[0]], [0, 1, -center[1]], [0, 0, 1]]) @ homography


def focal_of_homography(homography: Array, center: Array) -> float | None:
    """Computes the focal length in pixels from the perspective of a plane.

    It is the focal length at which the plane's axes are perpendicular and equally scaled.

    Args:
        homography: the homography (3, 3) from the plane in mm to pixels.
        center: (2,) the principal point in pixels.

    Returns:
        The focal length, or None if the view is too close to perpendicular to determine it.
    """
    h = _centred(homography, center)
    h = h / np.linalg.norm(h)
    a, b = h[:, 0], h[:, 1]
    # The columns a and b stand for the plane's axes; let w = 1 / f^2. Perpendicular axes require
    # w (a1 b1 + a2 b2) = -a3 b3. Equal scales require w (a1^2 + a2^2 - b1^2 - b2^2) = b3^2 - a3^2.
    # Solve both for w by least squares.
    left = np.array([a[:2] @ b[:2], (a[:2] @ a[:2] - b[:2] @ b[:2]) / 2])
    right = np.array([-a[2] * b[2], (b[2] ** 2 - a[2] ** 2) / 2])
    w = float(left @ right) / max(float(left @ left), 1e-30)
    if not w > 0:
        return None
    focal = 1 / math.sqrt(w)
    tilt = view_of(homography, focal, center).tilt
    return focal if tilt > _TELLING_TILT else None


def focal_of_height(homography: Array, height: float, start_px: float, center: Array) -> float:
    """Finds the focal length in pixels that puts the camera at a given height above the plane.

    Args:
        homography: the homography (3, 3) from the plane in mm to pixels.
        height: the camera's height in mm.
        start_px: the focal length at which the search starts.
        center: (2,) the principal point in pixels.
    """
    focal = start_px
    # The camera's height is proportional to the focal length only if the camera looks straight at
    # the plane. Otherwise one step is not enough, so iterate.
    for _ in range(20):
        focal *= height / view_of(homography, focal, center).camera[2]
    return focal


def aspect_of_quad(corners: Array, focal_px: float, center: Array) -> float:
    """Computes a rectangle's aspect ratio: its side between corners 0 and 1, divided by its side
    between corners 1 and 2.

    Args:
        corners: (4, 2) the rectangle's corners in pixels.
        focal_px: the focal length in pixels.
        center: (2,) the principal point in pixels.
    """
    h = _centred(square_to(corners), center) / np.array([[focal_px], [focal_px], [1.0]])
    return float(np.linalg.norm(h[:, 0]) / np.linalg.norm(h[:, 1]))


def square_to(corners: Array) -> Array:
    """Returns the homography (3, 3) that maps (0, 0), (1, 0), (1, 1), (0, 1) to corners (4, 2)."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    rows = []
    for (x, y), (u, v) in zip(square, corners, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    homography = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    return homography / homography[2, 2]


@dataclass(frozen=True)
class RectifiedPhoto:
    """The plane as seen from straight above, at the same scale everywhere."""

    pixels: Any
    """The RGB pixels (rows, columns, 3), 8 bits each."""
    seen: Any
    """A mask (rows, columns) of the pixels that the photo shows."""
    px_per_mm: float
    low: Array
    """The lower left corner (2,) of the picture, in mm."""

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and columns."""
        return self.pixels.shape[:2]

    @property
    def high(self) -> Array:
        """The upper right corner (2,) of the picture, in mm."""
        rows, columns = self.shape
        return self.low + np.array([columns, rows]) / self.px_per_mm

    def to_mm(self, pixels: Array) -> Array:
        """Converts columns and rows (n, 2), where whole numbers are pixel centres, to points (n, 2)
        in mm."""
        x, y = np.asarray(pixels, float).T
        top = self.high[1]
        return np.c_[self.low[0] + (x + 0.5) / self.px_per_mm, top - (y + 0.5) / self.px_per_mm]

    def to_px(self, points: Array) -> Array:
        """Converts points (n, 2) in mm to columns and rows (n, 2), where whole numbers are pixel
        centres."""
        x, y = np.asarray(points, float).T
        return np.c_[
            (x - self.low[0]) * self.px_per_mm - 0.5, (self.high[1] - y) * self.px_per_mm - 0.5
        ]


def rectify(
    cv2: Any, pixels: Any, view: PlaneView, low: Array, high: Array, px_per_mm: float
) -> RectifiedPhoto:
    """Returns the part of the plane from `low` to `high`, as seen from straight above.

    Args:
        cv2: OpenCV.
        pixels: (rows, columns, 3) the photo.
        view: the view of the plane.
        low: (2,) the lower left corner of the part, in mm.
        high: (2,) the upper right corner of the part, in mm.
        px_per_mm: the resolution of the result.
    """
    columns, rows = (np.ceil((high - low) * px_per_mm)).astype(int).tolist()
    top = low[1] + rows / px_per_mm
    to_plane = np.array(
        [
            [1 / px_per_mm, 0, low[0] + 0.5 / px_per_mm],
            [0, -1 / px_per_mm, top - 0.5 / px_per_mm],
            [0, 0, 1],
        ]
    )
    H = view.homography @ to_plane
    fine = view.px_per_mm((low + high) / 2)
    if fine > 1.3 * px_per_mm:
        # Average the photo over the area of a pixel of the result.
        pixels = cv2.GaussianBlur(pixels, (0, 0), 0.4 * fine / px_per_mm)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(pixels, H, (columns, rows), flags=flags)
    inside = np.full(pixels.shape[:2], 255, np.uint8)
    seen = cv2.warpPerspective(inside, H, (columns, rows), flags=cv2.WARP_INVERSE_MAP)
    # Leave out the photo's outermost pixels, which are interpolated with the empty area beyond.
    seen = cv2.erode(seen, np.ones((7, 7), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return RectifiedPhoto(image, seen > 250, px_per_mm, np.asarray(low, float))
