"""Finds the silhouettes of tools on a rectified photo, in mm."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from manifold3d import CrossSection, FillRule
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tracing.ground_light import flattened, log_light
from kitting_drake.hkd.tracing.photo_file import linear
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto
from kitting_drake.hkd.tracing.tool_mask import BOLD, ToolMasks, look_for

Array = NDArray[Any]

_RIM_MM = 1.2
"""The width, in mm, of the rim of a sheet that is ignored because the edge casts a shadow there."""
_LEAST_LOOP_MM2 = 4.0
_LEAST_TOOL_MM2 = 60.0
_FLAT_MM = 0.03
_EDGE_SLACK_MM = 0.4
"""Strips in which two masks differ are ignored if they are narrower than twice this, in mm."""
_BORDER_SLACK_MM = 3.3
"""Where a tool blends into a shadow, the true border lies in a strip of this width, in mm."""
_STRETCH_GAP_MM = 2.0
"""The largest gap between the parts of one stretch of unclear border, in mm."""


@dataclass(frozen=True)
class Unclear:
    """A region that may be tool, or may be ground or shadow."""

    region: CrossSection
    """The region, in mm."""
    area: float
    """The area of the region in which the border may lie, in mm^2."""

    @property
    def place(self) -> tuple[float, float]:
        """The middle (x, y) of the region, in mm."""
        x_low, y_low, x_high, y_high = self.region.bounds()
        return (x_low + x_high) / 2, (y_low + y_high) / 2


@dataclass(frozen=True)
class Silhouettes:
    """What `find_silhouettes` finds in a photo."""

    area: CrossSection
    """The region that tools cover, in mm."""
    blur_mm: float
    """The width of the blur of its border, in mm."""
    unclear: tuple[Unclear, ...]
    """The unclear regions, the largest first."""
    lightness: Array
    """(rows, columns) the logarithm of each pixel's light, relative to the lit ground."""


def find_silhouettes(
    cv2: Any,
    photo: RectifiedPhoto,
    sheet: Array | None,
    hidden: tuple[Array, ...],
    height: float | None = None,
) -> Silhouettes:
    """Finds the region that tools cover.

    Args:
        cv2: OpenCV.
        photo: the plane as seen from straight above.
        sheet: (2,) the sides of the sheet on which the tools lie, in mm; its lower left corner is
            the origin. None: there is no sheet, and tools may lie anywhere in the photo.
        hidden: polygons (n, 2) in mm in which no tools are sought.
        height: the height of the lowest tool, in mm; None: unknown.

    Raises:
        UserError: a tool extends beyond the sheet's edge.
    """
    ppm = photo.px_per_mm
    logs = log_light(photo.pixels)
    ground = photo.seen.copy()
    if sheet is not None:
        ground &= _polygon(cv2, photo, _rectangle(_RIM_MM, sheet - _RIM_MM))
    for polygon in hidden:
        ground &= ~_polygon(cv2, photo, polygon)
    ratio, spread = flattened(cv2, logs, ground, ppm)
    masks = ToolMasks(cv2, ratio, ground, spread, ppm)
    look = look_for(height, ppm)
    mask = masks.mask(look)
    if sheet is not None:
        inner = _polygon(cv2, photo, _rectangle(_RIM_MM + 0.5, sheet - _RIM_MM - 0.5))
        if mask[~inner].any():
            raise UserError(
                "a tool reaches over the sheet's edge: move it onto the sheet, or use a larger "
                "sheet (--sheet LENGTH WIDTH)"
            )
    lightness = ratio.mean(axis=2)
    if not mask.any():
        return Silhouettes(CrossSection(), 0.0, (), lightness)
    soft = soft_mask(cv2, photo, mask)
    area = cleaned(contours(photo, soft))
    differ = (mask ^ masks.mask(BOLD)) | masks.shine(mask) | masks.hidden_by_hue(mask, look)
    unclear = [*_unclear(cv2, photo, differ), *_blended(cv2, photo, masks.blended(mask))]
    unclear.sort(key=lambda item: -item.area)
    return Silhouettes(area, _blur_mm(cv2, soft, mask, ppm), tuple(unclear), lightness)


def _unclear(cv2: Any, photo: RectifiedPhoto, differ: Array) -> list[Unclear]:
    """Returns the regions of a mask (rows, columns) that are wider than twice `_EDGE_SLACK_MM`."""
    disc = _disc(cv2, _EDGE_SLACK_MM * photo.px_per_mm)
    differ = cv2.morphologyEx(differ, cv2.MORPH_OPEN, disc)
    return [Unclear(region, region.area()) for region in _regions(photo, differ)]


def _blended(cv2: Any, photo: RectifiedPhoto, border: Array) -> list[Unclear]:
    """Returns the stretches of unclear border in a mask (rows, columns)."""
    disc = _disc(cv2, _STRETCH_GAP_MM / 2 * photo.px_per_mm)
    _, labels = cv2.connectedComponents(cv2.dilate(border, disc))
    lengths = np.bincount(labels[border > 0], minlength=1) / photo.px_per_mm
    return [
        Unclear(region, _BORDER_SLACK_MM * float(length))
        for label, length in enumerate(lengths)
        if label and length
        for region in _regions(photo, labels == label)[:1]
    ]


def _regions(photo: RectifiedPhoto, mask: Array) -> list[CrossSection]:
    """Returns the connected regions of a mask (rows, columns), in mm, the largest first."""
    parts = contours(photo, mask.astype(np.float32)).decompose()
    return sorted(parts, key=lambda part: -part.area())


def _disc(cv2: Any, radius: float) -> Array:
    n = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))


def lightness_in(cv2: Any, photo: RectifiedPhoto, lightness: Array, region: CrossSection) -> float:
    """Returns the median of `Silhouettes.lightness` in a region in mm; NaN off the photo."""
    mask = np.zeros(photo.shape, np.uint8)
    loops = [
        np.round(photo.to_px(np.asarray(loop))).astype(np.int32) for loop in region.to_polygons()
    ]
    cv2.fillPoly(mask, loops, 1)
    inside = lightness[(mask > 0) & photo.seen]
    return float(np.median(inside)) if inside.size else math.nan


def _rectangle(low: Array | float, high: Array) -> Array:
    (x0, y0), (x1, y1) = np.broadcast_to(low, 2), high
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _polygon(cv2: Any, photo: RectifiedPhoto, polygon: Array) -> Array:
    mask = np.zeros(photo.shape, np.uint8)
    cv2.fillPoly(mask, [np.round(photo.to_px(polygon)).astype(np.int32)], 1)
    return mask > 0


def cleaned(area: CrossSection) -> CrossSection:
    """Removes specks and tiny holes from a region."""
    result = CrossSection()
    for part in area.decompose():
        loops = [np.asarray(loop) for loop in part.to_polygons()]
        sizes = [CrossSection([loop]).area() or CrossSection([loop[::-1]]).area() for loop in loops]
        if max(sizes, default=0) < _LEAST_TOOL_MM2:
            continue
        kept = [loop for loop, size in zip(loops, sizes, strict=True) if size >= _LEAST_LOOP_MM2]
        result += CrossSection(kept)
    return result.simplify(_FLAT_MM)


def _blur_mm(cv2: Any, soft: Array, mask: Array, ppm: float) -> float:
    """Returns the median width in mm over which a soft mask rises from 0 to 1 at its border."""
    x = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=ppm / 8)
    y = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=ppm / 8)
    slope = np.hypot(x, y)[(soft > 0.35) & (soft < 0.65)]
    return float(1 / max(np.median(slope), 1e-3)) if slope.size else 0.0


_BAND_MM = 0.7
"""The true outline is assumed to be within this distance of the edge of the mask, in mm."""
_SKIP_MM = 0.35
"""The least distance from the edge of the mask at which colours are sampled, in mm."""
_NEAR_MM = 0.8
"""The approximate radius, in mm, over which the sampled colours are averaged."""
_LEAST_CONTRAST = 0.03


def soft_mask(cv2: Any, photo: RectifiedPhoto, mask: Array) -> Array:
    """Estimates the share of each pixel that tools cover, near the edge of their mask.

    The colour of the tool is taken a little inside the edge, and that of the ground a little
    outside it. A shadow beside a tool therefore counts as ground.

    Returns:
        The covered share (rows, columns), from 0 to 1.
    """
    ppm = photo.px_per_mm
    u, v, width, height = cv2.boundingRect(mask)
    margin = int(4 * ppm)
    box = (
        slice(max(0, v - margin), v + height + margin),
        slice(max(0, u - margin), u + width + margin),
    )
    whole = np.zeros(mask.shape, np.float32)
    whole[box] = _soft(cv2, linear(photo.pixels[box]), mask[box], ppm)
    return whole


def _soft(cv2: Any, light: Array, mask: Array, ppm: float) -> Array:
    # Skip at least 1.5 pixels on both sides of the edge, because the photo is blurred there.
    skip = max(_SKIP_MM, 1.5 / ppm)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5) / ppm
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5) / ppm
    tool = _spread_colour(cv2, light, (inside > skip) & (inside < 2.0), ppm)
    ground = _spread_colour(cv2, light, (outside > skip) & (outside < 1.6), ppm)
    contrast = np.zeros_like(inside)
    share = np.zeros_like(inside)
    for k in range(3):
        along = tool[..., k] - ground[..., k]
        contrast += along * along
        share += (light[..., k] - ground[..., k]) * along
    share /= np.maximum(contrast, 1e-6)
    unsure = (contrast < _LEAST_CONTRAST**2) | (tool[..., 3] < 1e-3) | (ground[..., 3] < 1e-3)
    share[unsure] = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.2 * ppm)[unsure]
    share = np.clip(share, 0, 1)
    share[inside > _BAND_MM] = 1
    share[outside > _BAND_MM] = 0
    return cv2.GaussianBlur(share, (0, 0), 0.12 * ppm + 0.4)


def _spread_colour(cv2: Any, light: Array, where: Array, ppm: float) -> Array:
    """Averages, around each pixel, the colours of the pixels that are in a mask.

    Returns:
        The mean colour, and the share of nearby pixels that are in the mask, (rows, columns, 4).
    """
    stacked = np.empty((*where.shape, 4), np.float32)
    stacked[..., :3] = light
    stacked[..., 3] = 1
    stacked[~where] = 0
    # Three box filters approximate a Gaussian, and are faster.
    side = 2 * round(0.85 * _NEAR_MM * ppm) + 1
    for _ in range(3):
        stacked = cv2.blur(stacked, (side, side))
    stacked[..., :3] /= np.maximum(stacked[..., 3:], 1e-6)
    return stacked


def contours(photo: RectifiedPhoto, soft: Array) -> CrossSection:
    """Returns the region, in mm, in which a soft mask (rows, columns) exceeds one half."""
    import contourpy

    padded = np.pad(soft, 1)
    lines = contourpy.contour_generator(z=padded).lines(0.5)
    loops = [photo.to_mm(np.asarray(line)[:-1] - 1) for line in lines if len(line) > 8]
    return CrossSection(loops, FillRule.EvenOdd)
