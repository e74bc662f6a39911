"""Engraves each tool's name beside its cavity, or on the cavity's floor."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, FillRule, JoinType
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.hkd.fabrication.recess import Recess
from kitting_drake.hkd.kits.block import Cavity
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.kits.nesting import rasterized

DEPTH = 0.0006
"""The depth of the engraving, in metres."""
CAP_HEIGHTS = (0.007, 0.006, 0.005, 0.004)
"""Heights of capital letters to try, in metres."""

_MARGIN, _EDGE = 0.0014, 0.004
"""The least distances of letters in metres: from recesses, and from the block's edge."""
_CELL = 0.0007
"""The side of a raster cell, in metres."""
_FARTHEST = 0.03
"""The largest distance of a label from its cavity, in metres."""
_PLAINLY = 1.5
"""A label's distance from any other tool's cavity must exceed its distance from its own tool's
cavity by this factor."""
# The cost of a label beside its cavity, in metres, is the sum of: the label's distance from the
# cavity; a tenth of its distance from the cavity's middle; 6 mm if the text is rotated; and minus
# 6 times the height of its letters.
_DISTANCE_FOR_HEIGHT, _FROM_THE_SIDE, _OFF_THE_MIDDLE = 6.0, 0.006, 0.1
_FONT_SIZE = 100.0


@dataclass(frozen=True)
class _Lettering:
    """The outline of a text in metres, with its lower left corner at the origin."""

    outline: CrossSection
    cap_height: float
    """The height of the capital letters, in metres."""
    rotated: bool
    """Whether the text is turned by 90 degrees."""

    @property
    def size(self) -> tuple[float, float]:
        """The extents of the text along x and y, in metres."""
        _, _, x, y = self.outline.bounds()
        return x, y


@dataclass(frozen=True)
class _Raster:
    """A raster over the block on which masks are computed: rows along y, columns along x."""

    start: NDArray[np.float64]
    """The (x, y) of the raster's lower left corner in the kit frame, in metres."""
    counts: tuple[int, int]
    """The numbers of rows and columns."""

    def mask(self, outline: CrossSection) -> NDArray[np.bool_]:
        """Returns the mask (rows, columns) of the cells inside an outline."""
        if outline.is_empty():
            return np.zeros(self.counts, dtype=bool)
        return rasterized(outline, self.start, self.counts, _CELL)


def engrave_labels(
    kit: Kit, cavities: Sequence[Cavity], taken: Sequence[Recess]
) -> tuple[list[Recess], list[str]]:
    """Places a label for each tool of a kit.

    Args:
        kit: the kit; its tools' names are engraved.
        cavities: the cavities of the tools, in the tools' order.
        taken: the recesses cut so far; labels stay `_MARGIN` away from them.

    Returns:
        The labels, and a sentence for each tool whose label does not fit.
    """
    parameters = kit.parameters
    sides = np.array([parameters.length, parameters.width])
    rows, columns = (int(side / _CELL) for side in sides[::-1])
    raster = _Raster(-sides / 2, (rows, columns))
    rims = [raster.mask(cavity.rim) for cavity in cavities]
    margin = CrossSection.square(tuple(sides - 2 * _EDGE), True)
    for outline in (*(c.rim for c in cavities), *(r.outline for r in taken)):
        margin -= outline.offset(_MARGIN, JoinType.Round)
    free = raster.mask(margin)
    notched = CrossSection()
    for recess in taken:
        if recess.kind == "notch":
            notched += recess.outline.offset(_MARGIN, JoinType.Round)
    distances = [_distance(rim) for rim in rims]
    labels, notes = [], []
    for index, (tool, cavity) in enumerate(zip(kit.tools, cavities, strict=True)):
        choices = _letterings(tool.name.replace("_", " "))
        cost = distances[index]
        possible = cost <= _FARTHEST
        for other in (*distances[:index], *distances[index + 1 :]):
            possible &= _PLAINLY * cost < other
        cost = np.where(possible, cost + _OFF_THE_MIDDLE * _from_middle(rims[index]), np.inf)
        top = _placed(choices, free, raster, cost)
        if top is not None:
            free &= ~raster.mask(top.offset(3 * _MARGIN, JoinType.Round))
            labels.append(Recess("label", tool.name, top, parameters.height - DEPTH))
            continue
        floor = cavity.outline.offset(-_MARGIN, JoinType.Round) - notched
        inside = raster.mask(floor)
        # Inside a cavity, prefer the place farthest from the wall.
        depth = ndimage.distance_transform_edt(inside) * _CELL
        bottom = _placed(choices, inside, raster, depth.max() - depth)
        if bottom is not None:
            labels.append(Recess("label", tool.name, bottom, cavity.floor - DEPTH))
        else:
            notes.append(
                f"there is no room for a label of '{tool.name}': use a shorter name or thicker "
                "walls"
            )
    return labels, notes


def _distance(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the distance of each cell from a mask, in metres."""
    return ndimage.distance_transform_edt(~mask) * _CELL


def _from_middle(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the distance of each cell from the centre of a mask's bounding box, in metres."""
    rows, columns = np.nonzero(mask)
    row, column = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
    y, x = np.indices(mask.shape)
    return np.hypot(y - row, x - column) * _CELL


def _placed(
    choices: Sequence[_Lettering],
    free: NDArray[np.bool_],
    raster: _Raster,
    costs: NDArray[np.float64],
) -> CrossSection | None:
    """Finds the cheapest placement of a text whose bounding box covers only free cells.

    Args:
        choices: the same text at several sizes and rotations.
        free: (rows, columns) the cells that the text may cover.
        raster: the raster of the cells.
        costs: (rows, columns) the cost in metres of placing the text's middle in each cell;
            infinite where that is forbidden.

    Returns:
        The outlines of the placed letters in the kit frame; None if no placement is possible.
    """
    blocked = np.pad(np.cumsum(np.cumsum(~free, axis=0), axis=1), ((1, 0), (1, 0)))
    best, lowest = None, np.inf
    for choice in choices:
        columns, rows = (int(np.ceil(extent / _CELL)) for extent in choice.size)
        if rows > free.shape[0] or columns > free.shape[1]:
            continue
        count = (
            blocked[rows:, columns:]
            - blocked[:-rows, columns:]
            - blocked[rows:, :-columns]
            + blocked[:-rows, :-columns]
        )
        middle = np.s_[
            rows // 2 : rows // 2 + count.shape[0], columns // 2 : columns // 2 + count.shape[1]
        ]
        cost = np.where(count == 0, costs[middle], np.inf)
        if not np.isfinite(cost).any():
            continue
        row, column = np.unravel_index(int(np.argmin(cost)), cost.shape)
        total = cost[row, column] - _DISTANCE_FOR_HEIGHT * choice.cap_height
        total += _FROM_THE_SIDE * choice.rotated
        if total < lowest:
            corner = raster.start + _CELL * np.array([column, row])
            best, lowest = choice.outline.translate((float(corner[0]), float(corner[1]))), total
    return best


def _letterings(text: str) -> list[_Lettering]:
    """Lays out a text in each of `CAP_HEIGHTS`, upright and turned by 90 degrees."""
    # matplotlib is slow to import, and only labels need it.
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    # Bold strokes are wide enough for a 0.4 mm nozzle.
    font = FontProperties(family="DejaVu Sans", weight="bold")

    def glyphs(letters: str) -> CrossSection:
        path = TextPath((0, 0), letters, size=_FONT_SIZE, prop=font)
        loops = [loop[:-1] for loop in path.to_polygons() if len(loop) > 3]
        return CrossSection(loops, FillRule.NonZero)

    _, low, _, high = glyphs("H").bounds()
    drawn = glyphs(text)
    letterings = []
    for cap_height in CAP_HEIGHTS:
        scale = cap_height / (high - low)
        upright = drawn.scale((scale, scale)).simplify(1e-5)
        for outline in (upright, upright.rotate(90)):
            x, y, _, _ = outline.bounds()
            rotated = outline is not upright
            letterings.append(_Lettering(outline.translate((-x, -y)), cap_height, rotated))
    return letterings
