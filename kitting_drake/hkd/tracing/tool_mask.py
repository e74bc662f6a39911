"""Separates tools from a plain ground and from their shadows."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.tracing.ground_light import lightness_and_colour, roughness, steepness

Array = NDArray[Any]

_DARKER, _BRIGHTER, _COLOURED = 0.22, 0.12, 0.11
"""How much darker, brighter, or different in colour a pixel must be to count as unlike the ground,
in logarithms of light."""
_NO_SHADOW = 1.3
"""A pixel darker than the ground by more than this, in logarithms of light, is not in shadow."""
_BALL_MM = 0.9
"""The radius of the disc that `_reached` rolls over the ground, in mm."""
_ROUGH = 0.022
"""Surfaces less rough than this, in logarithms of light, count as smooth under the limits `MIDDLE`.
Other limits scale this value."""
_HOLE_BALL_MM = 0.6
_STRIP_MM = 1.2
"""In `_shaded_holes`, eroded regions that are at most twice this wide, in mm, are strips."""
_EDGE_MM = 2.3
"""Over the rough pixels at a tool's edge, the ground is extended by at most this far, in mm."""
_SHINE_STEEP = 0.6
"""The edge of a specular reflection is less steep than this, in logarithms of light per mm."""
_STEP_REACH_MM = 1.5
"""The radius around a pixel, in mm, of the area in which a brightness step is measured."""
_SHINY, _SHINY_SHARE = 0.06, 0.25
"""A bay or hole of a tool's mask is a reflection if more than `_SHINY_SHARE` of its pixels are
brighter than the ground by more than `_SHINY`, in logarithms of light."""
_SHINE_REACH_MM = 3.0
_GLARE, _GLARE_SPREADS = 0.025, 5.0
"""Glare is brighter than the ground by at least `_GLARE`, in logarithms of light, and by at least
`_GLARE_SPREADS` standard deviations of the ground's light."""
_GLARE_REACH_MM, _GLARE_GAP_MM, _GLARE_MM2, _GLARE_SHARE = 8.0, 2.5, 0.7, 0.25
"""Glare up to `_GLARE_REACH_MM` from a tool is added to the tool. A strip between the two is added
if it is narrower than twice `_GLARE_GAP_MM`. An added region has an area of at least `_GLARE_MM2`,
of which at least the share `_GLARE_SHARE` is brighter than the ground."""
_SAME_HUE, _SAME_HUE_TIMES = 0.008, 1.5
"""A pixel has the hue of the ground if its difference in colour is below `_SAME_HUE`, in logarithms
of light, or below `_SAME_HUE_TIMES` its median on the ground."""
_EVEN, _PLAIN = 0.1, 0.04
"""A bay or hole with the hue of the ground is ground if its median slope is below `_EVEN` per mm,
and 90 % of its pixels are brighter than lit ground by at most `_PLAIN`, both in logarithms of
light."""
_PLAIN_MM2, _RIM_MM = 3.0, 0.5
"""Pixels within `_RIM_MM` of the border are ignored. A bay of which less than `_PLAIN_MM2` is left
does not count as ground."""
_SOFT_SHARE, _SOFT_MM = 0.3, 3.0
"""A bay or hole is a reflection if more than `_SOFT_SHARE` of its border is soft. A stretch of
border is soft if most of it is, over a length of `_SOFT_MM`."""
_SMOOTH_MM = 1.5
"""Notches narrower than twice this, in mm, at the edge of a filled reflection are filled too."""
_TINTED_MM = 2.0
"""If the tool within this distance of a shadow has the hue of the ground, the shadow may be a part
of the tool."""
_BAY_MM = 12.0
"""Only bays and holes at most twice this wide, in mm, may be reflections."""
_BLENDED_MM, _SHADED = 1.2, 0.06
"""A tool blends into a shadow where the brightness step is wider than `_BLENDED_MM` and the shadow
is darker than `_SHADED`, in logarithms of light."""
_NEUTRAL = 0.05
"""Ground in shadow differs in colour from lit ground by less than this, in logarithms of light."""
_LARGEST_HOLE_MM2 = 500.0
"""A hole of at least this area, in mm^2, does not count as ground in shadow. A strip may have any
area."""
_UNLIKE_SHARE = 0.3
"""At least this share of a tool's pixels differs from the ground."""
_LEAST_AREA_MM2 = 40.0
_LEAST_HOLE_MM2 = 4.0
_LEAST_HOLE_RADIUS_MM = 0.7


@dataclass(frozen=True)
class ShadowLook:
    """The limits that distinguish shadows from tools."""

    steep: float
    """The largest slope of the logarithm of light, per mm, at the edge of a shadow. For pixels with
    the hue of the ground, it is at least that of `BOLD`."""
    rough: float
    """The largest ratio of a shadow's roughness to that of the plain ground. For pixels with the
    hue of the ground, it is at least that of `BOLD`."""
    shine: float
    """A brightness step is soft if it is wider than this, in mm, or if its slope is small."""


CAREFUL = ShadowLook(0.3, 2.0, 1.2)
"""The limits for high tools. Their shadows have soft edges, so faint edges count as tool edges."""
MIDDLE = ShadowLook(0.45, 3.0, 1.2)
"""The limits for low tools and for tools of unknown height."""
BOLD = ShadowLook(0.65, 4.0, math.inf)
"""The limits for a second opinion: faint edges count as shadow edges. The outline is in doubt where
the mask for these limits differs from the mask for `CAREFUL` or `MIDDLE`."""
_LOW_MM = 9.0
_COARSE_PX_PER_MM = 3.5
_FINE_PX_PER_MM = 5.0
"""Below this resolution, blur widens the brightness steps, so the limits of a step's width are
raised."""


def look_for(height: float | None, px_per_mm: float) -> ShadowLook:
    """Returns the limits for a height of the tools and a resolution of the photo.

    `CAREFUL` is not used for a coarse photo, in which a shadow's edge is as rough as a tool.

    Args:
        height: the tools' height in mm; None: unknown.
        px_per_mm: the resolution.
    """
    if height is None or height < _LOW_MM or px_per_mm < _COARSE_PX_PER_MM:
        return MIDDLE
    return CAREFUL


class ToolMasks:
    """Computes masks of the tools in one photo, for different limits."""

    def __init__(
        self, cv2: Any, ratio: Array, ground: Array, spread: float, px_per_mm: float
    ) -> None:
        """Measures lightness, colour, roughness and brightness steps in the photo.

        Args:
            cv2: OpenCV.
            ratio: (rows, columns, 3) the logarithms from `ground_light.flattened`.
            ground: (rows, columns) true where tools may be.
            spread: the standard deviation from `ground_light.flattened`.
            px_per_mm: the resolution.
        """
        self._cv2, self._ground, self._px_per_mm = cv2, ground, px_per_mm
        self._spread = spread
        self._smooth = cv2.GaussianBlur(ratio, (0, 0), 0.12 * px_per_mm + 0.3)
        self._lightness, self._colour = lightness_and_colour(cv2, self._smooth)
        self._steep = steepness(cv2, self._smooth, px_per_mm)
        self._noise = noise = max(1.0, 4 * spread / _DARKER)
        evidence = np.maximum(-self._lightness / _DARKER, self._lightness / _BRIGHTER)
        self._evidence = np.maximum(evidence, self._colour / _COLOURED) / noise
        self._evidence[~ground] = 0
        self._plain = self._evidence < 0.5
        usual = _median(self._colour[self._plain & ground], 0.0)
        self._hue_limit = max(_SAME_HUE, _SAME_HUE_TIMES * usual)
        light = cv2.transform(ratio, np.full((1, 3), 1 / 3, np.float32))
        even = cv2.GaussianBlur(light, (0, 0), 0.5 * px_per_mm)
        self._rough = roughness(cv2, light, even, px_per_mm)
        self._usual = _median(self._rough[self._plain & ground], _ROUGH)
        # The slope and the width of the steepest brightness step near each pixel.
        self._peak = cv2.dilate(self._steep, _disc(cv2, 0.7 * px_per_mm))
        disc = _disc(cv2, _STEP_REACH_MM * px_per_mm)
        span = cv2.dilate(self._lightness, disc) - cv2.erode(self._lightness, disc)
        self._width = span / np.maximum(self._peak, 1e-3)
        # A median filter keeps edges, so they do not count as roughness.
        self._fine = roughness(cv2, light, cv2.medianBlur(light, 5), px_per_mm)

    def mask(self, look: ShadowLook, *, by_hue: bool = True) -> Array:
        """Returns a mask (rows, columns): 1 where a tool hides the ground.

        Pixels that look like the ground are ground. Shadows count as ground, too: these are pixels
        without colour that no steep brightness step separates from the ground. With `by_hue`, the
        step may be steeper where the hue is that of the ground. All other pixels are tools. A
        watershed moves the border of the tools to the steepest brightness step nearby.
        """
        cv2, ground, px_per_mm, noise = self._cv2, self._ground, self._px_per_mm, self._noise
        neutral = (self._colour < self._hue_limit) & by_hue
        steepest = np.where(neutral, max(look.steep, BOLD.steep), look.steep).astype(np.float32)
        free = (self._steep < steepest * noise) & (self._colour < _COLOURED * noise)
        free &= (self._lightness > -_NO_SHADOW) & (self._lightness < _BRIGHTER * noise)
        free |= ~ground
        ratio = np.where(neutral, max(look.rough, BOLD.rough), look.rough).astype(np.float32)
        roughest = ratio * max(_ROUGH / 3, self._usual)
        even = (free & (self._rough < roughest)) | ~ground
        reached = _reached(cv2, even, self._plain, px_per_mm)
        # Every pixel of a small hole is near an edge. So find holes that lie wholly in shadow by a
        # roughness that ignores edges.
        usual = _median(self._fine[self._plain & ground], _ROUGH)
        limit = 1.7 * usual * np.exp(-self._lightness / 2)
        like_ground = (self._colour < _NEUTRAL * noise) & (self._fine < limit)
        shaded = free & (self._fine < 2 * limit) & ~reached
        reached |= _shaded_holes(cv2, shaded, like_ground, px_per_mm)
        # The edge of a tool is rough on both sides. So extend the ground over rough pixels, up to
        # a steep brightness step.
        for _ in range(math.ceil(_EDGE_MM * px_per_mm)):
            grown = cv2.dilate(reached.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            reached |= grown & free
        tool = _components(cv2, (~reached).astype(np.uint8), self._evidence, px_per_mm)
        widest = look.shine * max(1.0, _FINE_PX_PER_MM / px_per_mm)
        return self._bordered(self._with_glare(self._without_shine(tool, widest)))

    def shine(self, mask: Array) -> Array:
        """Returns a mask (rows, columns): 1 for bright pixels beside a given mask.

        They are clearly brighter than the ground, so they are probably reflections on a tool.
        """
        cv2 = self._cv2
        near = cv2.dilate(mask, _disc(cv2, _SHINE_REACH_MM * self._px_per_mm))
        bright = (self._lightness > 2 * _SHINY * self._noise) & self._ground
        return ((near > mask) & bright).astype(np.uint8)

    def hidden_by_hue(self, mask: Array, look: ShadowLook) -> Array:
        """Returns a mask (rows, columns): 1 where only the hue tells shadow from tool, although the
        tool nearby has the hue of the ground, too."""
        cv2, px_per_mm = self._cv2, self._px_per_mm
        neutral = ((mask > 0) & (self._colour < self._hue_limit)).astype(np.uint8)
        neutral = cv2.morphologyEx(neutral, cv2.MORPH_OPEN, _disc(cv2, _RIM_MM * px_per_mm))
        near = cv2.dilate(neutral, _disc(cv2, _TINTED_MM * px_per_mm))
        return near & (mask ^ self.mask(look, by_hue=False))

    def blended(self, mask: Array) -> Array:
        """Returns the border pixels of a mask (rows, columns) at which the tool blends into a
        shadow."""
        cv2 = self._cv2
        border = (mask > 0) & (cv2.erode(mask, _disc(cv2, 1)) == 0)
        widest = _BLENDED_MM * max(1.0, _FINE_PX_PER_MM / self._px_per_mm)
        outside = (mask == 0).astype(np.float32)
        side = 2 * round(_STEP_REACH_MM * self._px_per_mm) + 1
        count = np.maximum(cv2.blur(outside, (side, side)), 1e-3)
        shaded = cv2.blur(self._lightness * outside, (side, side)) < -_SHADED * count
        return (border & shaded & (self._width > widest)).astype(np.uint8)

    def _with_glare(self, tool: Array) -> Array:
        """Adds the regions beside a tool that are brighter than the ground.

        Such regions are glare on the tool, because light never makes the ground beside a tool
        brighter. A strip between the tool and its glare may be as bright as the ground; it is
        added, too.
        """
        cv2, px_per_mm = self._cv2, self._px_per_mm
        least = max(_GLARE, _GLARE_SPREADS * self._spread)
        bright = ((self._lightness > least) & self._ground).astype(np.uint8)
        bright = cv2.morphologyEx(bright, cv2.MORPH_OPEN, _disc(cv2, 0.2 * px_per_mm))
        bright &= cv2.dilate(tool, _disc(cv2, _GLARE_REACH_MM * px_per_mm))
        both = cv2.morphologyEx(
            tool | bright, cv2.MORPH_CLOSE, _disc(cv2, _GLARE_GAP_MM * px_per_mm)
        )
        added = both & ~tool & 1
        # Keep the strips that lead to glare, but not the notches that the closing has filled.
        _, labels, stats, _ = cv2.connectedComponentsWithStats(added, connectivity=4)
        share = np.bincount(labels[bright > 0], minlength=len(stats)) / np.maximum(stats[:, 4], 1)
        kept = (share > _GLARE_SHARE) & (stats[:, 4] > _GLARE_MM2 * px_per_mm**2)
        kept[0] = False
        return tool | kept[labels].astype(np.uint8)

    def _without_shine(self, tool: Array, widest: float) -> Array:
        """Fills the bays and holes of a mask that are reflections on a tool.

        Their border with the tool is soft, or they are brighter than the ground, and they are not
        plain ground. A brightness step that is wider than `widest`, in mm, is soft. A reflection
        may open into a true gap: the part of a bay that is nearest to a soft border is examined on
        its own.
        """
        cv2 = self._cv2
        closed = _closed(cv2, tool, _BAY_MM * self._px_per_mm, self._px_per_mm)
        rim = (tool > 0) & (cv2.erode(tool, _disc(cv2, 1)) == 0)
        bays = (closed & (tool == 0)).astype(np.uint8)
        soft = rim & ((self._peak < _SHINE_STEEP) | (self._width > widest))
        filled = self._filled(tool, bays, rim, soft)
        if not soft.any():
            return filled
        near = bays & ~filled & 1 & _nearest(cv2, soft, rim, self._px_per_mm)
        near[self._colour < self._hue_limit] = 0
        both = self._filled(filled, near, rim, soft)
        disc = _disc(cv2, _SMOOTH_MM * self._px_per_mm)
        grown = cv2.dilate(both & ~filled & 1, disc)
        return both | (cv2.morphologyEx(both, cv2.MORPH_CLOSE, disc) & grown & bays)

    def _filled(self, tool: Array, bays: Array, rim: Array, soft: Array) -> Array:
        """Returns a mask with those regions of `bays` filled that are reflections."""
        cv2, px_per_mm = self._cv2, self._px_per_mm
        count, labels, stats, _ = cv2.connectedComponentsWithStats(bays, connectivity=4)
        filled = tool.copy()
        for i in range(1, count):
            x, y, width, height, area = stats[i]
            if area < 0.5 * px_per_mm**2:
                continue
            box = (slice(max(0, y - 2), y + height + 2), slice(max(0, x - 2), x + width + 2))
            bay = labels[box] == i
            border = (cv2.dilate(bay.astype(np.uint8), _disc(cv2, 1)) > 0) & rim[box]
            if not border.any() or self._is_plain(box, bay):
                continue
            bright = (self._lightness[box][bay] > _SHINY).mean() > _SHINY_SHARE
            # Part of a reflection's border may be sharp.
            if bright or soft[box][border].mean() > _SOFT_SHARE:
                filled[box][bay] = 1
        return filled

    def _is_plain(self, box: tuple[slice, slice], region: Array) -> bool:
        """Whether a region, away from its border, is ground: evenly lit, of the ground's hue, and
        nowhere brighter than lit ground."""
        disc = _disc(self._cv2, _RIM_MM * self._px_per_mm)
        inside = self._cv2.erode(region.astype(np.uint8), disc) > 0
        if inside.sum() < _PLAIN_MM2 * self._px_per_mm**2:
            return False
        return bool(
            np.median(self._colour[box][inside]) < self._hue_limit
            and np.median(self._steep[box][inside]) < _EVEN
            and np.percentile(self._lightness[box][inside], 90) < _PLAIN
        )

    def _bordered(self, tool: Array) -> Array:
        """Moves the border of a mask to the steepest brightness step nearby."""
        cv2, px_per_mm = self._cv2, self._px_per_mm
        markers = np.zeros(tool.shape, np.int32)
        markers[cv2.dilate(tool, _disc(cv2, 0.4 * px_per_mm)) == 0] = 1
        markers[cv2.erode(tool, _disc(cv2, 0.4 * px_per_mm)) > 0] = 2
        markers[~self._ground] = 1
        image = ((np.clip(-self._smooth, -0.3, 2.25) + 0.3) * 100).astype(np.uint8)
        cv2.watershed(np.ascontiguousarray(image), markers)
        mask = (markers == 2).astype(np.uint8)
        # The watershed's lines belong to neither side. Assign each of their pixels to the side that
        # has more of the neighbouring pixels.
        mask[(markers == -1) & (cv2.blur(mask.astype(np.float32), (3, 3)) > 0.4)] = 1
        return _cleaned(cv2, mask, self._evidence, px_per_mm)


def _median(values: Array, otherwise: float) -> float:
    return float(np.median(values)) if values.size else otherwise


def _reached(cv2: Any, even: Array, plain: Array, px_per_mm: float) -> Array:
    """Finds the pixels that a rolling disc can cover.

    The disc starts on plain ground, and all pixels below it must be smooth.

    Args:
        cv2: OpenCV.
        even: (rows, columns) true where the picture is smooth, as on the ground or in a shadow.
        plain: (rows, columns) true where lightness and colour are those of the ground.
        px_per_mm: the resolution.
    """
    disc = _disc(cv2, _BALL_MM * px_per_mm)
    room = cv2.erode(even.astype(np.uint8), disc)
    count, labels = cv2.connectedComponents(room, connectivity=4)
    home = cv2.erode((plain & even).astype(np.uint8), disc)
    table = np.bincount(labels[home > 0], minlength=count) > 0
    table[0] = False
    return cv2.dilate(table[labels].astype(np.uint8), disc) > 0


def _shaded_holes(cv2: Any, even: Array, like_ground: Array, px_per_mm: float) -> Array:
    """Finds smooth regions that look like ground in shadow: holes, and strips beside a tool."""
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


def _nearest(cv2: Any, soft: Array, rim: Array, px_per_mm: float) -> Array:
    """Returns a mask (rows, columns): 1 where the nearest stretch of a rim is mostly soft."""
    side = 2 * round(_SOFT_MM / 2 * px_per_mm) + 1
    share = cv2.blur(soft.astype(np.float32), (side, side))
    mostly = share > 0.5 * cv2.blur(rim.astype(np.float32), (side, side))
    _, labels = cv2.distanceTransformWithLabels(
        1 - rim.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(labels.max()) + 1, np.uint8)
    table[labels[rim]] = mostly[rim]
    return table[labels]


def _closed(cv2: Any, mask: Array, radius: float, px_per_mm: float) -> Array:
    """Closes a mask morphologically with a large disc. The resolution is reduced to save time."""
    rows, columns = mask.shape
    factor = max(1, int(px_per_mm / 1.5))
    margin = math.ceil(radius / factor) + 2
    small = cv2.resize(mask, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    small = cv2.copyMakeBorder(small, *(margin,) * 4, cv2.BORDER_CONSTANT, value=0)
    small = cv2.morphologyEx(small, cv2.MORPH_CLOSE, _disc(cv2, radius / factor))
    small = small[margin:-margin, margin:-margin].astype(np.float32)
    return cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR) > 0.5


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
    """Removes specks, and fills holes that are small or narrow."""
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
