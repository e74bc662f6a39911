"""Finds the parts of a block that a printer cannot make: walls thinner than its nozzle, and
undercuts."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.design import Design, in_block
from kitting_drake.hkd.fabrication.recess import Recess
from kitting_drake.hkd.fabrication.splitting.opening import (
    corner_area,
    thin_parts,
    united,
)

_TINY = 1e-9
"""The area in square metres below which an overlap is ignored as a rounding error."""


def wall_notes(design: Design, nozzle: float) -> list[str]:
    """Returns a sentence for each missing wall of a block, and for each wall thinner than a nozzle.

    Args:
        design: the block.
        nozzle: the nozzle's width, in metres.
    """
    parameters = design.kit.parameters
    recesses = [recess for recess in design.recesses if recess.kind != "label"]
    room = CrossSection.square((parameters.length, parameters.width), True)
    found: dict[str, tuple[float, str]] = {}
    for joined, text in _vanished(design, recesses, room):
        found[joined] = (0.0, text)
    floors = sorted({recess.floor for recess in recesses})
    for floor in floors:
        open_there = [recess for recess in recesses if recess.floor <= floor]
        material = room - united(recess.outline for recess in open_there)
        for part in thin_parts(material, nozzle).decompose():
            if part.area() < corner_area(nozzle):
                continue
            between = _between(part, open_there, room, nozzle)
            thickness = _thickness(part, material, nozzle)
            if between not in found or thickness < found[between][0]:
                place = _place(part, design)
                text = (
                    f"the wall between {between} is {1e3 * thickness:.2f} mm thin at {place}, less "
                    f"than the nozzle's {1e3 * nozzle:g} mm"
                )
                found[between] = (thickness, text)
    return [text for _, text in found.values()]


def undercut_notes(solid: Manifold, design: Design) -> list[str]:
    """Returns a sentence for each tool whose cavity is partly covered by an overhang.

    Args:
        solid: the block from `design.solid`, in mm.
        design: the block's design.
    """
    mesh = solid.to_mesh64()
    corners = np.asarray(mesh.vert_properties, dtype=float)[:, :3][np.asarray(mesh.tri_verts)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    lowest = design.outside.raised_mm + design.outside.chamfer_mm + 0.01
    down = (normals[:, 2] < -0.02 * areas) & (areas > 1e-3)
    down &= corners[:, :, 2].mean(axis=1) > lowest
    found: dict[str, str] = {}
    for triangle, area in zip(corners[down], areas[down], strict=True):
        middle = triangle.mean(axis=0)
        tool = min(design.recesses, key=lambda r: _distance(middle, r, design)).tool
        found.setdefault(
            tool,
            f"the block overhangs the cavity of '{tool}' at ({middle[0]:.1f}, {middle[1]:.1f}, "
            f"{middle[2]:.1f}) by {area:.2f} square mm: it needs support",
        )
    return list(found.values())


def _vanished(
    design: Design, recesses: Sequence[Recess], room: CrossSection
) -> Iterator[tuple[str, str]]:
    """Finds missing walls, where a cavity overlaps another cavity or the block's side.

    Yields:
        A text that names the two things that the wall should separate, and a sentence for the user.
    """
    cavities = [recess for recess in recesses if recess.kind == "cavity"]
    for one, other in itertools.combinations(cavities, 2):
        common = one.outline ^ other.outline
        if common.area() > _TINY:
            between = _and(_quoted([one.tool]) + _quoted([other.tool]))
            yield between, f"there is no wall between {between} at {_place(common, design)}"
    for recess in cavities:
        beyond = recess.outline - room
        if beyond.area() > _TINY:
            between = _and([*_quoted([recess.tool]), "the block's side"])
            yield between, f"there is no wall between {between} at {_place(beyond, design)}"


def _between(
    part: CrossSection, recesses: Sequence[Recess], room: CrossSection, nozzle: float
) -> str:
    """Returns a text that names the tools, or the block's side, beside a wall."""
    near = part.offset(nozzle / 2, JoinType.Round)
    names = dict.fromkeys(r.tool for r in recesses if not (near ^ r.outline).is_empty())
    sides = _quoted(names)
    if not (near - room).is_empty():
        sides.append("the block's side")
    return _and(sides) if len(sides) > 1 else f"the parts of {_and(sides)}"


def _thickness(part: CrossSection, material: CrossSection, nozzle: float) -> float:
    """Returns the thickness of a wall where it is thinnest, in metres."""
    x_min, y_min, x_max, y_max = part.bounds()
    box = CrossSection.square((x_max - x_min + 4 * nozzle, y_max - y_min + 4 * nozzle))
    here = material ^ box.translate((x_min - 2 * nozzle, y_min - 2 * nozzle))
    low, high = 0.0, nozzle
    while high - low > 5e-6:
        middle = (low + high) / 2
        if (thin_parts(here, middle) ^ part).area() > corner_area(middle) + _TINY / 100:
            high = middle
        else:
            low = middle
    return high


def _place(part: CrossSection, design: Design) -> str:
    x_min, y_min, x_max, y_max = part.bounds()
    middle = np.array([((x_min + x_max) / 2, (y_min + y_max) / 2)])
    ((x, y),) = in_block(middle, design.kit.parameters)
    return f"({x:.1f}, {y:.1f})"


def _distance(point: NDArray[np.float64], recess: Recess, design: Design) -> float:
    """Returns the horizontal distance of a point (3) from a recess's bounding box, in mm."""
    x_min, y_min, x_max, y_max = recess.outline.bounds()
    corners = in_block(np.array([(x_min, y_min), (x_max, y_max)]), design.kit.parameters)
    outside = np.maximum(corners[0] - point[:2], point[:2] - corners[1])
    return float(np.linalg.norm(np.maximum(outside, 0.0)))


def _quoted(names: Sequence[str] | dict[str, None]) -> list[str]:
    return [f"'{name}'" for name in names]


def _and(names: Sequence[str]) -> str:
    return " and ".join(names)
