"""Finds the edges of a sheet of paper in a photo, to a fraction of a pixel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_SIDE = 900
_LEAST_SHARE = 0.04
"""A sheet must cover at least this share of the photo's area."""
_SAMPLES = 400
_LEAST_SUPPORT = 0.4
"""At least this share of each edge must be visible."""
_REACHES = ((0.012, 0.005), (0.05, 0.012, 0.005))
"""The distances from a rough edge within which the true edge is sought.

They are shares of the photo's longer side. Each row is one attempt, in which its distances are used
one after the other. The second row begins with a larger distance, for an edge that a tool hides.
"""
_CLOSE_PX = 2.5
"""A point that is closer than this to a line, in pixels, counts as on the line."""
_SAME_QUAD = 0.02
"""Quadrilaterals count as one if their corners differ by less than this share of `_SMALL_SIDE`."""


@dataclass(frozen=True)
class SheetQuad:
    """The four edges of a sheet in a photo."""

    corners: Array
    """The corners (4, 2) in pixels, counter-clockwise in the picture."""
    support: Array
    """The visible share (4,) of each edge."""
    edges: tuple[Array, ...]
    """Points (n, 2) on each edge, in pixels."""
    width_px: float
    """The width of the edges' blur, in pixels."""


def find_quads(cv2: Any, pixels: Any) -> list[SheetQuad]:
    """Finds the quadrilaterals in a photo that may be a sheet, the largest first."""
    scale = min(1.0, _SMALL_SIDE / max(pixels.shape[:2]))
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    rough: list[Array] = []
    for mask in _masks(cv2, small):
        for quad in _quads_of(cv2, mask):
            if not any(np.abs(quad - other).max() < _SAME_QUAD * _SMALL_SIDE for other in rough):
                rough.append(quad)
    gray = cv2.GaussianBlur(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    found: list[SheetQuad] = []
    for quad in rough:
        refined = _refined(cv2, gray, (quad + 0.5) / scale - 0.5)
        if refined is not None and not any(
            np.abs(refined.corners - other.corners).max() < 0.01 * max(pixels.shape)
            for other in found
        ):
            found.append(refined)
    return sorted(found, key=lambda quad: -_area(quad.corners))


def _area(corners: Array) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def _masks(cv2: Any, small: Any) -> Iterator[Any]:
    """Yields masks of regions that differ from their surroundings in lightness or colour."""
    lab = cv2.cvtColor(cv2.GaussianBlur(small, (0, 0), 1.5), cv2.COLOR_RGB2LAB)
    size = np.ones((5, 5), np.uint8)
    spread = np.abs(lab[..., 1:].astype(int) - 128).max(axis=2)
    paleness = np.clip(lab[..., 0].astype(int) - 2 * spread, 0, 255).astype(np.uint8)
    for channel in (lab[..., 0], paleness, lab[..., 2]):
        otsu, _ = cv2.threshold(channel, 0, 255, cv2.THRESH_OTSU)
        levels = np.percentile(channel, (20, 35, 50, 65, 80))
        for level in dict.fromkeys([int(otsu), *levels.astype(int).tolist()]):
            above = (channel > level).astype(np.uint8)
            for mask in (above, 1 - above):
                opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, size)
                yield cv2.morphologyEx(opened, cv2.MORPH_CLOSE, size)


def _quads_of(cv2: Any, mask: Any) -> Iterator[Array]:
    """Yields quadrilaterals (4, 2) around the connected regions of a mask."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rows, columns = mask.shape
    for contour in contours:
        area = cv2.contourArea(contour)
        if area < _LEAST_SHARE * mask.size:
            continue
        points = contour[:, 0]
        border = (
            (points[:, 0] <= 1)
            | (points[:, 1] <= 1)
            | (points[:, 0] >= columns - 2)
            | (points[:, 1] >= rows - 2)
        )
        if border.mean() > 0.1:
            continue
        hull = cv2.convexHull(contour)
        quad = _four_sides(cv2, hull)
        if quad is None:
            continue
        if not 0.55 * _area(quad) < area < 1.1 * _area(quad):
            continue
        yield quad


def _four_sides(cv2: Any, hull: Any) -> Array | None:
    """Returns the corners (4, 2) where the lines of the four longest sides of a convex hull meet.

    Returns None if these corners do not form a convex quadrilateral close to the hull.
    """
    length = cv2.arcLength(hull, True)
    polygon = cv2.approxPolyDP(hull, 0.008 * length, True)[:, 0].astype(float)
    if len(polygon) < 4:
        return None
    sides = np.roll(polygon, -1, axis=0) - polygon
    # Keep the four longest sides, in their order around the hull.
    longest = sorted(np.argsort(-np.linalg.norm(sides, axis=1))[:4].tolist())
    lines = [_line(polygon[i], polygon[i] + sides[i]) for i in longest]
    corners = [_crossing(lines[i - 1], lines[i]) for i in range(4)]
    if any(corner is None for corner in corners):
        return None
    quad = np.array(corners)
    sides = np.roll(quad, -1, axis=0) - quad
    turns = [float(np.linalg.det(sides[[i - 1, i]])) for i in range(4)]
    if min(turns) < 0 < max(turns):
        return None
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    margin = 0.2 * (high - low)
    if np.any(quad < low - margin) or np.any(quad > high + margin):
        return None
    # Order the corners counter-clockwise in the picture, where rows point down.
    return quad if turns[0] < 0 else quad[::-1]


def _line(start: Array, end: Array) -> Array:
    """Returns (a, b, c) of the line a x + b y = c through two points, with a^2 + b^2 = 1."""
    along = (end - start) / np.linalg.norm(end - start)
    normal = np.array([-along[1], along[0]])
    return np.array([*normal, normal @ start])


def _crossing(first: Array, second: Array) -> Array | None:
    matrix = np.array([first[:2], second[:2]])
    if abs(np.linalg.det(matrix)) < 0.2:
        return None
    return np.linalg.solve(matrix, [first[2], second[2]])


def _refined(cv2: Any, gray: Any, corners: Array) -> SheetQuad | None:
    """Moves the edges of a quadrilateral to the steepest changes of lightness nearby.

    A sheet is assumed to be lighter than the desk on all sides, or darker on all sides.
    """
    quads = [
        quad
        for sign in (1, -1)
        for reaches in _REACHES
        if (quad := _refined_as(cv2, gray, corners, sign, reaches))
    ]
    return max(quads, key=lambda quad: float(quad.support.sum()), default=None)


def _refined_as(
    cv2: Any, gray: Any, corners: Array, sign: int, reaches: tuple[float, ...]
) -> SheetQuad | None:
    for reach in reaches:
        edges = [
            _edge(cv2, gray, corners[i], corners[(i + 1) % 4], reach * max(gray.shape), sign)
            for i in range(4)
        ]
        fits = [edge for edge in edges if edge is not None]
        if len(fits) < 4:
            return None
        crossings = [_crossing(fits[i - 1][0], fits[i][0]) for i in range(4)]
        met = [crossing for crossing in crossings if crossing is not None]
        if len(met) < 4:
            return None
        corners = np.array(met)
    support = np.array([fit[1] for fit in fits])
    if support.min() < _LEAST_SUPPORT:
        return None
    width = float(np.median([fit[3] for fit in fits]))
    return SheetQuad(corners, support, tuple(fit[2] for fit in fits), width)


def _edge(
    cv2: Any, gray: Any, start: Array, end: Array, reach: float, sign: int
) -> tuple[Array, float, Array, float] | None:
    """Fits a line to the steepest changes of lightness near a segment.

    Args:
        cv2: OpenCV.
        gray: (rows, columns) the lightness.
        start: (2,) the start of the segment in pixels.
        end: (2,) the end of the segment in pixels.
        reach: how far from the segment to search, in pixels.
        sign: 1 if the lightness rises in the direction (-y, x), where (x, y) is the direction of
            the segment; -1 if it falls.

    Returns:
        The line (a, b, c), the share of the segment that supports it, the points (n, 2) on it, and
        the width of the blur in pixels. None if there is no such line.
    """
    along = end - start
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    shares = np.linspace(0.03, 0.97, _SAMPLES)
    steps = np.arange(-np.ceil(reach), np.ceil(reach) + 1)
    where = start + shares[:, None] * along
    grid = (where[:, None] + steps[None, :, None] * normal).astype(np.float32)
    profiles = cv2.remap(
        gray, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(float)
    rows, columns = gray.shape
    inside = ((where >= 2) & (where <= (columns - 3, rows - 3))).all(axis=1)
    slopes = sign * np.gradient(profiles, axis=1)
    peak = np.argmax(slopes, axis=1)
    index = np.arange(len(peak))
    height = slopes[index, peak]
    keep = inside & (peak > 0) & (peak < len(steps) - 1) & (height > 1.5)
    if keep.sum() < 20:
        return None
    a, b, c = (slopes[index, np.clip(peak + k, 0, len(steps) - 1)] for k in (-1, 0, 1))
    bend = np.minimum(a - 2 * b + c, -1e-6)
    offset = steps[peak] + np.clip(0.5 * (a - c) / bend, -1, 1)
    line, close = _robust_line(shares[keep], offset[keep])
    if not close.any():
        return None
    points = (where + offset[:, None] * normal)[keep]
    ends = [start + s * along + (line[0] + line[1] * s) * normal for s in (0.0, 1.0)]
    rise = np.ptp(profiles[keep][close], axis=1) / np.maximum(height[keep][close], 1e-6)
    support = float(close.sum()) / len(shares)
    return _line(*ends), support, points[close], float(np.median(rise))


def _robust_line(shares: Array, offsets: Array) -> tuple[Array, Array]:
    """Fits a line to points near a segment, and ignores outliers.

    Args:
        shares: (n) each point's position along the segment, from 0 at its start to 1 at its end.
        offsets: (n) each point's offset from the segment.

    Returns:
        The line's offset at share 0 and its slope; and a mask (n) of the points close to the line.
    """
    rng = np.random.default_rng(0)
    design = np.c_[np.ones_like(shares), shares]
    first, second = rng.integers(0, len(shares), (2, 200))
    apart = np.abs(shares[first] - shares[second]) > 0.1
    first, second = first[apart], second[apart]
    slopes = (offsets[second] - offsets[first]) / (shares[second] - shares[first])
    starts = offsets[first] - slopes * shares[first]
    close = np.abs(offsets - starts[:, None] - slopes[:, None] * shares) < _CLOSE_PX
    best = close[np.argmax(close.sum(axis=1))] if len(close) else np.zeros(len(shares), bool)
    line = np.zeros(2)
    for _ in range(3):
        if best.sum() < 2:
            break
        line = np.linalg.lstsq(design[best], offsets[best], rcond=None)[0]
        best = np.abs(offsets - design @ line) < _CLOSE_PX
    return line, best
