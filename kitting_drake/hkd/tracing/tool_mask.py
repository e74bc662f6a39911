"""Separates tools from a plain ground and from their shadows."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_DARKER, _BRIGHTER, _COLOURED = 0.22, 0.12, 0.11
"""The least differences from the ground that may be a tool, in logarithms of light: darker,
brighter, or differently coloured."""
_NO_SHADOW = 1.3
"""The largest darkening by a shadow, in logarithms of light."""
_STEEP = 0.45
"""The slope at which an edge is too steep to be a shadow's, in logarithms of light per mm."""
_BALL_MM = 0.9
"""The radius of the disc that must fit wherever the ground is found, in mm."""
_ROUGH = 0.022
"""The least roughness of a tool's surface, in logarithms of light."""
_MOST_FINE = 0.1
_HOLE_BALL_MM = 0.6
_STRIP_MM = 1.2
_EDGE_MM = 2.3
_SHINE_STEEP = 0.6
"""The largest slope of the edge of a specular reflection, in logarithms of light per mm."""
_BAY_MM = 8.0
"""Half the width, in mm, below which a bright band with soft edges across a tool is a
reflection."""
_NEUTRAL = 0.05
_LARGEST_HOLE_MM2 = 500.0
"""The area in mm^2 above which a hole must show ground that is not in shadow."""
_UNLIKE_SHARE = 0.3
_LEAST_AREA_MM2 = 40.0
_LEAST_HOLE_MM2 = 4.0
_LEAST_HOLE_RADIUS_MM = 0.7


def tool_mask(cv2: Any, ratio: Array, ground: Array, spread: float, px_per_mm: float) -> Array:
    """Separates tools from the ground and from shadows.

    Pixels that look like the ground are ground. Shadows are ground too: they are neutral in colour,
    and connected to the ground without a steep step. The rest is a tool. Finally a watershed moves
    the border to the steepest step between the two.

    Args:
        cv2: OpenCV.
        ratio: (rows, columns, 3) the logarithms from `ground_light.flattened`.
        ground: (rows, columns) true where tools may be.
        spread: the standard deviation from `ground_light.flattened`.
        px_per_mm: the resolution.

    Returns:
        A mask (rows, columns): 1 where a tool hides the ground.
    """
    smooth = cv2.GaussianBlur(ratio, (0, 0), 0.12 * px_per_mm + 0.3)
    lightness, colour = _lightness_and_colour(cv2, smooth)
    steep = _steepness(cv2, smooth, px_per_mm)
    noise = max(1.0, 4 * spread / _DARKER)
    evidence = np.maximum(-lightness / _DARKER, lightness / _BRIGHTER)
    evidence = np.maximum(evidence, colour / _COLOURED) / noise
    evidence[~ground] = 0
    free = (steep < _STEEP * noise) & (colour < _COLOURED * noise)
    free &= (lightness > -_NO_SHADOW) & (lightness < _BRIGHTER * noise)
    free |= ~ground
    plain = evidence < 0.5
    light = cv2.transform(ratio, np.full((1, 3), 1 / 3, np.float32))
    rough = _roughness(cv2, light, cv2.GaussianBlur(light, (0, 0), 0.5 * px_per_mm), px_per_mm)
    usual = _median(rough[plain & ground], _ROUGH)
    even = (free & (rough < max(_ROUGH, 3 * usual))) | ~ground
    reached = _reached(cv2, even, plain, px_per_mm)
    # A hole may lie wholly in shadow, so its edges are close. A median filter keeps edges, so they
    # do not count as roughness.
    finely = _roughness(cv2, light, cv2.medianBlur(light, 5), px_per_mm)
    limit = 1.7 * _median(finely[plain & ground], _ROUGH) * np.exp(-lightness / 2)
    like_ground = (colour < _NEUTRAL * noise) & (finely < limit)
    reached |= _shaded_holes(cv2, free & (finely < 2 * limit) & ~reached, like_ground, px_per_mm)
    # The edge of a tool is rough on both sides. So extend the ground over rough pixels, up to a
    # steep step.
    for _ in range(math.ceil(_EDGE_MM * px_per_mm)):
        reached |= (cv2.dilate(reached.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & free
    tool = _components(cv2, (~reached).astype(np.uint8), evidence, px_per_mm)
    tool = _without_shine(cv2, tool, steep, px_per_mm)
    markers = np.zeros(ratio.shape[:2], np.int32)
    markers[cv2.dilate(tool, _disc(cv2, 0.4 * px_per_mm)) == 0] = 1
    markers[cv2.erode(tool, _disc(cv2, 0.4 * px_per_mm)) > 0] = 2
    markers[~ground] = 1
    image = ((np.clip(-smooth, -0.3, 2.25) + 0.3) * 100).astype(np.uint8)
    cv2.watershed(np.ascontiguousarray(image), markers)
    mask = (markers == 2).astype(np.uint8)
    # The watershed's lines belong to neither side; assign each to the side with more of its
    # neighbours.
    mask[(markers == -1) & (cv2.blur(mask.astype(np.float32), (3, 3)) > 0.4)] = 1
    return _cleaned(cv2, mask, evidence, px_per_mm)


def _median(values: Array, otherwise: float) -> float:
    return float(np.median(values)) if values.size else otherwise


def _lightness_and_colour(cv2: Any, logs: Array) -> tuple[Array, Array]:
    """Returns the mean of the three logarithms, and the largest deviation of one from the mean."""
    lightness = cv2.transform(logs, np.full((1, 3), 1 / 3, np.float32))
    colour = np.zeros_like(lightness)
    for k in range(3):
        colour = np.maximum(colour, np.abs(logs[..., k] - lightness))
    return lightness, colour


def _steepness(cv2: Any, smooth: Array, px_per_mm: float) -> Array:
    """Returns the largest slope (rows, columns) of any colour, per mm."""
    steep = np.zeros(smooth.shape[:2], np.float32)
    for k in range(3):
        x = cv2.Sobel(smooth[..., k], cv2.CV_32F, 1, 0, scale=px_per_mm / 8)
        y = cv2.Sobel(smooth[..., k], cv2.CV_32F, 0, 1, scale=px_per_mm / 8)
        steep = np.maximum(steep, cv2.magnitude(x, y))
    return steep


def _roughness(cv2: Any, light: Array, even: Array, px_per_mm: float) -> Array:
    """Returns the local root mean square (rows, columns) of the differences from a smoothed
    picture."""
    fine = np.clip(light - even, -_MOST_FINE, _MOST_FINE)
    return np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), 0.5 * px_per_mm))


def _reached(cv2: Any, even: Array, plain: Array, px_per_mm: float) -> Array:
    """Finds the pixels that a disc can cover as it rolls over `even` pixels from plain ground."""
    disc = _disc(cv2, _BALL_MM * px_per_mm)
    room = cv2.erode(even.astype(np.uint8), disc)
    count, labels = cv2.connectedComponents(room, connectivity=4)
    home = cv2.erode((plain & even).astype(np.uint8), disc)
    table = np.bincount(labels[home > 0], minlength=count) > 0
    table[0] = False
    return cv2.dilate(table[labels].astype(np.uint8), disc) > 0


def _shaded_holes(cv2: Any, even: Array, like_ground: Array, px_per_mm: float) -> Array:
    """Finds even regions that look like ground in shadow: holes, and strips beside a tool."""
    disc = _disc(cv2, _HOLE_BALL_MM * px_per_mm)
    room = cv2.erode(even.astype(np.uint8), disc)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(room, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    alike = np.bincount(labels[like_ground], minlength=count) / np.maximum(area, 1)
    inner = cv2.distanceTransform(room, cv2.DIST_L2, 3) > _STRIP_MM * px_per_mm
    wide = np.bincount(labels[inner], minlength=count) > 0
    table = (alike > 0.8) & (area > 1.5 * px_per_mm**2)
    table &= ~wide | (area < _LARGEST_HOLE_MM2 * px_per_mm**2)
    table[0] = False
    return cv2.dilate(table[labels].astype(np.uint8), disc) > 0


def _without_shine(cv2: Any, tool: Array, steep: Array, px_per_mm: float) -> Array:
    """Fills bays and holes of a tool whose border is soft, because they are reflections."""
    rows, columns = tool.shape
    # Work at a lower resolution, because a large disc is slow at the full one.
    factor = max(1, int(px_per_mm / 1.5))
    margin = math.ceil(_BAY_MM * px_per_mm / factor) + 2
    small = cv2.resize(tool, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    small = cv2.copyMakeBorder(small, *(margin,) * 4, cv2.BORDER_CONSTANT, value=0)
    small = cv2.morphologyEx(small, cv2.MORPH_CLOSE, _disc(cv2, _BAY_MM * px_per_mm / factor))
    small = small[margin:-margin, margin:-margin].astype(np.float32)
    closed = cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR) > 0.5
    peak = cv2.dilate(steep, _disc(cv2, 0.7 * px_per_mm))
    rim = (tool > 0) & (cv2.erode(tool, _disc(cv2, 1)) == 0)
    bays = (closed & (tool == 0)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bays, connectivity=4)
    filled = tool.copy()
    for i in range(1, count):
        x, y, width, height, area = stats[i]
        if area < 0.5 * px_per_mm**2:
            continue
        box = (slice(max(0, y - 2), y + height + 2), slice(max(0, x - 2), x + width + 2))
        bay = labels[box] == i
        border = (cv2.dilate(bay.astype(np.uint8), _disc(cv2, 1)) > 0) & rim[box]
        if not border.any():
            continue
        if np.median(peak[box][border]) < _SHINE_STEEP:
            filled[box][bay] = 1
    return filled


def _disc(cv2: Any, radius: float) -> Any:
    n = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))


def _components(cv2: Any, mask: Array, evidence: Array, px_per_mm: float) -> Array:
    """Keeps the connected regions that are as large as a tool and differ from the ground."""
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(cv2, 0.2 * px_per_mm))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_AREA_MM2 * px_per_mm**2
    large[0] = False
    unlike = np.bincount(labels[evidence > 1], minlength=len(stats))
    large &= unlike > _UNLIKE_SHARE * stats[:, cv2.CC_STAT_AREA]
    return large[labels].astype(np.uint8)


def _cleaned(cv2: Any, mask: Array, evidence: Array, px_per_mm: float) -> Array:
    """Removes specks, and fills the holes that do not show the ground."""
    mask = _components(cv2, mask, evidence, px_per_mm)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    for i in range(1, count):
        x, y, width, height, area = stats[i]
        if x == 0 or y == 0 or x + width == mask.shape[1] or y + height == mask.shape[0]:
            continue
        box = (slice(y, y + height), slice(x, x + width))
        hole = labels[box] == i
        padded = np.pad(hole, 1).astype(np.uint8)
        radius = cv2.distanceTransform(padded, cv2.DIST_L2, 5).max() / px_per_mm
        if area < _LEAST_HOLE_MM2 * px_per_mm**2 or radius < _LEAST_HOLE_RADIUS_MM:
            mask[box][hole] = 1
    return mask
