"""Evens out the light on a plain ground, so that the objects on it stand out, and measures what is
left."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.tracing.photo_file import linear

Array = NDArray[Any]

_FLOOR = 0.012
"""A value added to linear light before the logarithm, so that noise in dark areas stays small."""
_SMOOTH_MM = 20.0
_FIT_POINTS = 20_000
_MOST_FINE = 0.1


def log_light(pixels: Array) -> Array:
    """Returns the logarithm (rows, columns, 3) of the linear light of sRGB pixels of the same
    shape."""
    codes = np.arange(256, dtype=np.uint8)
    return np.log(linear(codes) + np.float32(_FLOOR))[pixels]


def flattened(cv2: Any, logs: Array, ground: Array, px_per_mm: float) -> tuple[Array, float]:
    """Divides each pixel by the ground's light at that pixel, as a difference of logarithms.

    Args:
        cv2: OpenCV.
        logs: (rows, columns, 3) from `log_light`.
        ground: (rows, columns) true where the ground may be visible.
        px_per_mm: the resolution.

    Returns:
        The logarithm (rows, columns, 3) of each pixel's ratio to the ground, and the standard
        deviation of this logarithm on the ground.
    """
    rows, columns = ground.shape
    v, u = np.nonzero(ground)
    rng = np.random.default_rng(0)
    pick = rng.choice(len(u), min(_FIT_POINTS, len(u)), replace=False)
    u, v = u[pick], v[pick]
    values = logs[v, u].astype(float)
    design = _terms(u / columns - 0.5, v / rows - 0.5)
    coefficients = _robust_fit(design, values)
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    x, y = x / columns - 0.5, y / rows - 0.5
    ratio = np.empty_like(logs)
    for k in range(3):
        a = coefficients[:, k].astype(np.float32)
        light = a[0] + x * (a[1] + a[3] * x + a[4] * y) + y * (a[2] + a[5] * y)
        ratio[..., k] = logs[..., k] - light
    residual = values - design @ coefficients
    near = np.abs(residual).max(axis=1) < 0.15
    spread = 1.4826 * float(np.median(np.abs(residual[near]))) if near.sum() > 50 else 0.15
    # The polynomial misses some of the light's unevenness: subtract a blur of the visible ground.
    plain = (ground & (_largest(ratio) < max(0.06, 3 * spread))).astype(np.float32)
    step = max(1, int(px_per_mm))
    small = cv2.resize(plain, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA)
    sigma = _SMOOTH_MM * px_per_mm / step
    weight = cv2.GaussianBlur(small, (0, 0), sigma)
    for k in range(3):
        part = cv2.resize(
            ratio[..., k] * plain, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA
        )
        rest = cv2.GaussianBlur(part, (0, 0), sigma) / np.maximum(weight, 1e-3)
        ratio[..., k] -= cv2.resize(rest, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return ratio, spread


def lightness_and_colour(cv2: Any, logs: Array) -> tuple[Array, Array]:
    """Returns two values for each pixel: the mean of its three logarithms, and the largest
    deviation of a logarithm from this mean."""
    lightness = cv2.transform(logs, np.full((1, 3), 1 / 3, np.float32))
    colour = np.zeros_like(lightness)
    for k in range(3):
        colour = np.maximum(colour, np.abs(logs[..., k] - lightness))
    return lightness, colour


def steepness(cv2: Any, smooth: Array, px_per_mm: float) -> Array:
    """Returns (rows, columns): at each pixel, the largest slope of the three channels, per mm."""
    steep = np.zeros(smooth.shape[:2], np.float32)
    for k in range(3):
        x = cv2.Sobel(smooth[..., k], cv2.CV_32F, 1, 0, scale=px_per_mm / 8)
        y = cv2.Sobel(smooth[..., k], cv2.CV_32F, 0, 1, scale=px_per_mm / 8)
        steep = np.maximum(steep, cv2.magnitude(x, y))
    return steep


def roughness(cv2: Any, light: Array, even: Array, px_per_mm: float) -> Array:
    """Returns the local root mean square (rows, columns) of the differences from a smoothed
    picture."""
    fine = np.clip(light - even, -_MOST_FINE, _MOST_FINE)
    return np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), 0.5 * px_per_mm))


def _largest(ratio: Array) -> Array:
    """Returns the largest absolute value (rows, columns) of each pixel's three channels."""
    a, b, c = (np.abs(ratio[..., k]) for k in range(3))
    return np.maximum(np.maximum(a, b), c)


def _terms(x: Array, y: Array) -> Array:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _robust_fit(design: Array, values: Array) -> Array:
    """Fits coefficients (6, 3) by least squares with Tukey's weights, so that outliers do not
    count."""
    # Start from the most frequent lightness.
    light = values.mean(axis=1)
    counts, edges = np.histogram(light, bins=60)
    counts = np.convolve(counts, [1, 2, 3, 2, 1], mode="same")
    mode = edges[np.argmax(counts)] + (edges[1] - edges[0]) / 2
    center = np.median(values[np.abs(light - mode) < 0.15], axis=0)
    coefficients = np.zeros((6, 3))
    coefficients[0] = center
    for width in (0.45, 0.35, 0.25, 0.2, 0.15, 0.12, 0.1, 0.1):
        residual = np.abs(values - design @ coefficients).max(axis=1)
        weights = np.clip(1 - (residual / width) ** 2, 0, None) ** 2
        if (weights > 0).sum() < 50:
            break
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(design * root, values * root, rcond=None)[0]
    return coefficients
