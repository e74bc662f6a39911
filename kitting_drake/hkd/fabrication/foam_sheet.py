"""Arranges kits on a foam sheet or in a drawer, and draws the sheet in millimetres."""

import io
import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.hkd.fabrication.closed_lines import add_layer, new_dxf, svg_path, text_of

MOST_KITS = 60
"""The largest number of kits on a sheet."""

_MIXTURES = 40
"""In this many of the tried packings, random copies of the kit are turned by 90 degrees."""
_SHEET, _BLOCK = "SHEET", "BLOCK"
_STROKES = ("#0b5fa5", "#2b8a3e", "#9c36b5", "#d9480f", "#087f5b", "#a61e4d", "#5f3dc4")
_COLOURS = (4, 3, 6, 30, 2, 1, 150, 80)


@dataclass(frozen=True)
class SheetKit:
    """The outlines of a kit's block and recesses, which are drawn on a sheet."""

    name: str
    size: tuple[float, float]
    """The length and width of the kit's block, in mm."""
    height: float
    """The height of the kit's block, in mm."""
    layers: dict[str, list[NDArray[np.float64]]]
    """The closed loops (n, 2) in mm, by layer. The origin is the block's lower left corner."""


@dataclass(frozen=True)
class KitPlace:
    """The place of a kit on a sheet."""

    kit: int
    """The index of the kit in `FoamSheet.kits`."""
    x: float
    """The x of the block's lower left corner on the sheet, in mm."""
    y: float
    """The y of the block's lower left corner on the sheet, in mm."""
    turned: bool
    """Whether the kit is turned by 90 degrees, counter-clockwise."""


@dataclass(frozen=True)
class FoamSheet:
    """A sheet with kits."""

    size: tuple[float, float]
    """The length and width of the sheet, in mm."""
    margin: float
    """The least distance of a block from the sheet's edge, in mm."""
    gap: float
    """The least distance between two blocks, in mm."""
    kits: tuple[SheetKit, ...]
    places: tuple[KitPlace, ...]
    notes: tuple[str, ...]
    """A sentence for each kit that found no room, and for other things that a user should know."""


def kit_of_dxf(name: str, text: str, height: float) -> SheetKit:
    """Reads a kit from the text of its `cavities.dxf`.

    Args:
        name: the kit's name.
        text: the content of the file.
        height: the height of the kit's block, in mm.

    Raises:
        UserError: the text is not a drawing that `hkd kit` writes.
        MachineError: ezdxf is not installed.
    """
    ezdxf = import_extra("ezdxf", purpose="DXF", extra="fabrication")
    layers: dict[str, list[NDArray[np.float64]]] = {}
    try:
        for line in ezdxf.read(io.StringIO(text)).modelspace().query("LWPOLYLINE"):
            layers.setdefault(line.dxf.layer, []).append(np.array(line.get_points("xy")))
        (block,) = layers[_BLOCK]
    except (ezdxf.DXFError, KeyError, ValueError) as error:
        raise UserError(f"the cavities.dxf of '{name}' is damaged: make the kit again") from error
    length, width = block.max(axis=0)
    return SheetKit(name, (float(length), float(width)), height, layers)


def kit_of_folder(folder: Path) -> SheetKit:
    """Reads a kit from the folder that `hkd kit` wrote.

    Raises:
        UserError: the folder's `kit.json` or `cavities.dxf` is missing or damaged.
    """
    try:
        record = json.loads((folder / "kit.json").read_text())
        height = float(record["block"][2])
        text = (folder / "cavities.dxf").read_text()
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError(
            f"{folder} is not a folder that `hkd kit` wrote: its kit.json or cavities.dxf is "
            "missing or damaged"
        ) from error
    return kit_of_dxf(folder.name, text, height)


def fill_sheet(
    size: tuple[float, float],
    margin: float,
    gap: float,
    kits: Sequence[SheetKit],
    copies: int | None,
) -> FoamSheet:
    """Places kits on a sheet, each as it is or turned by 90 degrees.

    Args:
        size: the sheet's sides, in mm.
        margin: see `FoamSheet`.
        gap: see `FoamSheet`.
        kits: the kits to place, at least one.
        copies: the number of copies of each kit; None: copies are added until no more fit.

    Raises:
        UserError: a kit is larger than the part of the sheet inside the margins.
    """
    room = (size[0] - 2 * margin, size[1] - 2 * margin)
    for kit in kits:
        if not any(a <= room[0] and b <= room[1] for a, b in (kit.size, kit.size[::-1])):
            block, given = (f"{a:g} by {b:g} mm" for a, b in (kit.size, size))
            raise UserError(
                f"'{kit.name}' of {block} does not fit on a sheet of {given} with margins of "
                f"{margin:g} mm: give a larger --sheet or a smaller --margin_mm"
            )
    best: list[KitPlace] = []
    for places in _packings(room, gap, kits, copies):
        if _merit(places, kits) > _merit(best, kits):
            best = places
    placed = tuple(
        KitPlace(p.kit, round(p.x + margin, 4), round(p.y + margin, 4), p.turned) for p in best
    )
    notes = []
    for index, kit in enumerate(kits):
        count = sum(place.kit == index for place in placed)
        if count < (copies or 1):
            notes.append(
                f"{(copies or 1) - count} of {copies or 1} copies of '{kit.name}' find no room on "
                "the sheet"
            )
    heights = sorted({kit.height for kit in kits})
    if len(heights) > 1:
        text = " and ".join(f"{height:g}" for height in heights)
        notes.append(f"the kits are made for blocks of different heights: {text} mm")
    return FoamSheet(size, margin, gap, tuple(kits), placed, tuple(notes))


def _merit(places: Sequence[KitPlace], kits: Sequence[SheetKit]) -> tuple[int, float]:
    """Returns the number of different kits on the sheet, and the area in mm^2 that kits cover.

    Of two packings, the better one has the larger number or, if the numbers are equal, the larger
    area.
    """
    present = len({place.kit for place in places})
    return present, sum(math.prod(kits[place.kit].size) for place in places)


def _packings(
    room: tuple[float, float], gap: float, kits: Sequence[SheetKit], copies: int | None
) -> Iterator[list[KitPlace]]:
    """Yields packings of kits, from which the best one can be chosen."""
    areas = [math.prod(kit.size) for kit in kits]
    largest_first = sorted(range(len(kits)), key=lambda i: -areas[i])
    most = MOST_KITS if copies is None else copies * len(kits)
    rounds = itertools.islice(itertools.cycle(largest_first), most)
    order = list(rounds) if copies is None else [i for i in largest_first for _ in range(copies)]
    patterns: list[Sequence[bool] | None] = [None]
    if len(kits) == 1:
        count = min(len(order), int(room[0] * room[1] / areas[0]) + 1)
        order = order[:count]
        # Try each number of turned copies, placed before or after the other copies. Then turn
        # copies at random, because the densest packing may mix both directions like a pinwheel.
        for first, number in itertools.product((False, True), range(count + 1)):
            patterns.append([first] * number + [not first] * (count - number))
        mixtures = np.random.default_rng(0).random((_MIXTURES, count)) < 0.5
        patterns += mixtures.tolist()
    for by_rows, turned in itertools.product((True, False), patterns):
        yield _packed(room, gap, kits, order, turned, by_rows)


def _packed(
    room: tuple[float, float],
    gap: float,
    kits: Sequence[SheetKit],
    order: Sequence[int],
    turned: Sequence[bool] | None,
    by_rows: bool,
) -> list[KitPlace]:
    """Places kits on a sheet one after the other, and leaves out those that find no room.

    Args:
        room: the sides of the sheet without its margins, in mm.
        gap: the least distance between two blocks, in mm.
        kits: the kits.
        order: the indices of the kits to place.
        turned: whether to turn each kit in `order`; None: each is turned if this packs it better.
        by_rows: whether each kit goes as low as possible; if not, it goes as far left as possible.
    """
    places: list[KitPlace] = []
    boxes = np.empty((0, 4))
    hopeless: set[tuple[int, bool | None]] = set()
    for number, kit in enumerate(order):
        choice = None if turned is None else turned[number]
        if (kit, choice) in hopeless:
            continue
        options = []
        for turn in (False, True) if choice is None else (choice,):
            sides = np.array(kits[kit].size[::-1] if turn else kits[kit].size)
            corner = _free_corner(room, gap, boxes, sides, by_rows)
            if corner is not None:
                far = corner + sides
                key = (far[1], far[0]) if by_rows else (far[0], far[1])
                options.append((*key, turn, corner, sides))
        if not options:
            hopeless.add((kit, choice))
            continue
        _, _, turn, corner, sides = min(options, key=lambda option: option[:3])
        boxes = np.vstack([boxes, [*corner, *(corner + sides)]])
        places.append(KitPlace(kit, float(corner[0]), float(corner[1]), turn))
    return places


def _free_corner(
    room: tuple[float, float],
    gap: float,
    boxes: NDArray[np.float64],
    sides: NDArray[np.float64],
    by_rows: bool,
) -> NDArray[np.float64] | None:
    """Finds the lowest (if `by_rows`) or leftmost place for a rectangle.

    Args:
        room: the sides of the sheet without its margins, in mm.
        gap: the least distance from other rectangles, in mm.
        boxes: the placed rectangles (n, 4) as x_min, y_min, x_max, y_max, in mm.
        sides: the sides (2) of the rectangle to place, in mm.
        by_rows: whether to look for the lowest place.

    Returns:
        The lower left corner (2) in mm, or None if there is no room.
    """
    xs = np.concatenate([[0.0], boxes[:, 2] + gap])
    ys = np.concatenate([[0.0], boxes[:, 3] + gap])
    x, y = (axis.ravel() for axis in np.meshgrid(xs, ys))
    inside = (x + sides[0] <= room[0] + 1e-6) & (y + sides[1] <= room[1] + 1e-6)
    x, y = x[inside], y[inside]
    near = gap - 1e-6
    apart = (
        (x[:, None] + sides[0] + near <= boxes[:, 0])
        | (boxes[:, 2] + near <= x[:, None])
        | (y[:, None] + sides[1] + near <= boxes[:, 1])
        | (boxes[:, 3] + near <= y[:, None])
    )
    free = apart.all(axis=1)
    if not free.any():
        return None
    x, y = x[free], y[free]
    first = np.lexsort((x, y) if by_rows else (y, x))[0]
    return np.array([x[first], y[first]])


def sheet_layers(sheet: FoamSheet) -> dict[str, list[NDArray[np.float64]]]:
    """Returns the closed loops (n, 2) in mm of each layer of a sheet.

    The first layers are SHEET and BLOCK. Then there is a layer for each kind and depth of recess.
    """
    length, width = sheet.size
    layers = {_SHEET: [np.array([(0, 0), (length, 0), (length, width), (0, width)], dtype=float)]}
    layers[_BLOCK] = []
    for place in sheet.places:
        for name, loops in sheet.kits[place.kit].layers.items():
            layers.setdefault(name, []).extend(moved(loop, place, sheet) for loop in loops)
    depths = sorted((name for name in layers if name not in (_SHEET, _BLOCK)), key=_depth_order)
    return {name: layers[name] for name in (_SHEET, _BLOCK, *depths)}


def moved(points: NDArray[np.float64], place: KitPlace, sheet: FoamSheet) -> NDArray[np.float64]:
    """Converts points (n, 2) in mm from the frame of a placed kit to the sheet's frame."""
    if place.turned:
        width = sheet.kits[place.kit].size[1]
        points = np.column_stack([width - points[:, 1], points[:, 0]])
    return np.round(points + np.array([place.x, place.y]), 4)


def _depth_order(name: str) -> tuple[str, float]:
    kind, _, rest = name.partition("_")
    number = re.match(r"[0-9.]+", rest)
    return kind, float(number[0]) if number else 0.0


def sheet_dxf(sheet: FoamSheet) -> str:
    """Draws a sheet as a DXF, with the layers of `sheet_layers`."""
    document: Any = new_dxf()
    length, width = sheet.size
    for number, (name, loops) in enumerate(sheet_layers(sheet).items()):
        colour = {_SHEET: 8, _BLOCK: 7}.get(name, _COLOURS[number % len(_COLOURS)])
        add_layer(document, name, colour, loops)
    document.header["$EXTMIN"], document.header["$EXTMAX"] = (0, 0, 0), (length, width, 0)
    document.set_modelspace_vport(height=1.1 * max(length, width), center=(length / 2, width / 2))
    return text_of(document)


def sheet_svg(sheet: FoamSheet) -> str:
    """Draws a sheet as an SVG in units of 1 mm, with a group for each layer of `sheet_layers`."""
    length, width = sheet.size
    names = ", ".join(dict.fromkeys(sheet.kits[place.kit].name for place in sheet.places))
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" width="{length:g}mm" '
        f'height="{width:g}mm" viewBox="0 0 {length:g} {width:g}">',
        f"  <title>Sheet with {len(sheet.places)} kits: {escape(names)}</title>",
    ]
    for number, (name, loops) in enumerate(sheet_layers(sheet).items()):
        stroke = "#000000" if name in (_SHEET, _BLOCK) else _STROKES[number % len(_STROKES)]
        lines.append(f'  <g id="{name}" fill="none" stroke="{stroke}" stroke-width="0.1">')
        flipped = (np.column_stack([loop[:, 0], width - loop[:, 1]]) for loop in loops)
        lines += [f'    <path d="{svg_path(loop)}"/>' for loop in flipped]
        lines.append("  </g>")
    return "\n".join([*lines, "</svg>", ""])
