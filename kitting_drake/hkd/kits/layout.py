"""The layout of a kit: the size of its block, and the poses and outlines of its cavities.

A toolset has at most one tool of each of the paper's categories. Its tools are placed in fixed
slots, one for each category. Tools are nested (packed closely) instead if they are not a toolset,
if one is too large for its slot, or if `always_nested` is set. The block of nested tools has the
smallest size found or a given size.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.grasps.proposals import RELEASE_REACH
from kitting_drake.hkd.kits.block import ARC_SEGMENTS, Cavity
from kitting_drake.hkd.kits.nesting import LONGEST_SIDES, NestedShape, Nesting, nest, nest_on
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool
from systems.hand_geometry import FINGER_LENGTH

SLOTS = {
    "hammer": (0.02, 0.03),
    "pliers": (0.0, -0.03),
    "wrench": (0.0, -0.09),
    "screwdriver": (0.0, 0.09),
}
"""The origin (x, y) of the tool frame T of each category in the kit frame, in metres."""

MOST_TOOLS = 12
"""The largest number of tools in a kit."""

_SHALLOWEST = 0.003
"""The least depth of a cavity below its bevel, in metres."""

_SIZE_STEP = 0.001
"""The length and width of a nested block are multiples of this, in metres."""


@dataclass(frozen=True)
class CavityPose:
    """The pose of a seated tool's frame T in the kit frame K; lengths in metres."""

    x: float
    y: float
    z: float
    yaw: float = 0.0
    """The rotation about K's z, in radians."""


@dataclass(frozen=True)
class KitLayout:
    """The size of a kit's block and the poses of its tools."""

    parameters: KitParameters
    """The kit's parameters; their length and width are those of its block."""
    poses: tuple[CavityPose, ...]
    """The poses of the seated tools, in the tools' order."""


def slot_pose(tool: Tool, parameters: KitParameters) -> CavityPose:
    """Returns the pose of a tool in its category's slot (see `SLOTS`).

    Raises:
        KeyError: the tool's category has no slot.
    """
    x, y = SLOTS[tool.category]
    return CavityPose(x, y, _floor(tool, parameters))


def _floor(tool: Tool, parameters: KitParameters) -> float:
    """Returns the height of the floor of a tool's cavity in the kit frame, in metres.

    On this floor, the tool's top is `stand_out` above the block's top.
    """
    return parameters.height - tool.height + parameters.stand_out


def cavity_outline(outline: CrossSection, parameters: KitParameters) -> CrossSection:
    """Closes a tool's outline morphologically and grows it by the clearance.

    Holes are filled, because they would leave thin pillars in the cavity.
    """
    closing, clearance = parameters.closing_radius, parameters.clearance
    # Simplify only at the start and the end, because each simplification may move the outline.
    grown = outline.simplify(parameters.tolerance / 4).offset(
        closing + clearance, JoinType.Round, circular_segments=ARC_SEGMENTS
    )
    closed = grown.offset(-closing, JoinType.Round, circular_segments=ARC_SEGMENTS)
    # Loops around holes are clockwise and have negative areas.
    loops = [loop for loop in closed.to_polygons() if _signed_area(loop) > 0]
    return CrossSection(loops).simplify(parameters.tolerance)


def _signed_area(loop: NDArray[np.float64]) -> float:
    x, y = loop.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


def layout_kit(tools: Sequence[Tool], parameters: KitParameters) -> KitLayout:
    """Chooses the block's size and the poses of the tools: in their slots if they fit, else nested.

    Raises:
        UserError: there are no tools or too many, a tool is too high for the block or stands out of
            it too far, or the tools do not fit on a block.
    """
    if not 1 <= len(tools) <= MOST_TOOLS:
        raise UserError(f"a kit holds 1 to {MOST_TOOLS} tools, not {len(tools)}")
    for tool in tools:
        _check_height(tool, parameters)
    categories = [tool.category for tool in tools]
    unlike = len(set(categories)) == len(categories) and set(categories) <= set(SLOTS)
    if unlike and not parameters.always_nested:
        slots = tuple(slot_pose(tool, parameters) for tool in tools)
        if _has_walls(kit_cavities(tools, parameters, slots), parameters):
            return KitLayout(parameters, slots)
    return _nested_layout(tools, parameters)


def _check_height(tool: Tool, parameters: KitParameters) -> None:
    """Raises UserError if a tool is too high for the block, or stands out of its cavity so far that
    it is not held."""
    if _floor(tool, parameters) < parameters.minimum_wall - 1e-9:
        raise UserError(
            f"'{tool.name}' is {1e3 * tool.height:.1f} mm high: in a block of "
            f"{1e3 * parameters.height:.1f} mm, less than "
            f"{1e3 * parameters.minimum_wall:.1f} mm (kit.minimum_wall) would be left below it; "
            "use a higher block"
        )
    most = max(tool.height - parameters.lead_in - _SHALLOWEST, 0.0)
    if parameters.stand_out > most + 1e-9:
        raise UserError(
            f"'{tool.name}' is {1e3 * tool.height:.1f} mm high and is not held if it stands out by "
            f"{1e3 * parameters.stand_out:g} mm: let it stand out by at most {1e3 * most:.1f} mm"
        )


def _nested_layout(tools: Sequence[Tool], parameters: KitParameters) -> KitLayout:
    def shape(tool: Tool) -> NestedShape:
        outline = cavity_outline(tool.footprint, parameters.of_tool(tool.name))
        rim = Cavity(outline, 0.0, parameters.height, parameters.lead_in).rim
        return NestedShape(rim, released_fingers(tool))

    shapes = [shape(tool) for tool in tools]
    if parameters.fixed_size:
        nesting = _nested_on_given_block(tools, shapes, parameters)
        length, width = parameters.length, parameters.width
    else:
        nesting = _nested_on_least_block(tools, shapes, parameters)
        length, width = _block_sides(nesting)
    return KitLayout(
        dataclasses.replace(parameters, length=length, width=width),
        tuple(
            CavityPose(pose.x, pose.y, _floor(tool, parameters), math.radians(pose.yaw_deg))
            for tool, pose in zip(tools, nesting.poses, strict=True)
        ),
    )


def _wall(parameters: KitParameters) -> float:
    return max(parameters.minimum_wall, parameters.nested_wall)


def _block_sides(nesting: Nesting) -> tuple[float, float]:
    """Returns the sides of the smallest block that holds a nesting, in metres."""
    length, width = (
        _SIZE_STEP * math.ceil(side / _SIZE_STEP) for side in (nesting.length, nesting.width)
    )
    return length, width


def _nested_on_least_block(
    tools: Sequence[Tool], shapes: Sequence[NestedShape], parameters: KitParameters
) -> Nesting:
    nesting = nest(shapes, _wall(parameters))
    if nesting is None:
        sides = " by ".join(f"{1e3 * side:.0f}" for side in LONGEST_SIDES)
        raise UserError(
            f"{_quoted(tools)} do not fit into one kit, whose block can be at most {sides} mm: use "
            "fewer tools"
        )
    return nesting


def _nested_on_given_block(
    tools: Sequence[Tool], shapes: Sequence[NestedShape], parameters: KitParameters
) -> Nesting:
    nesting = nest_on(shapes, _wall(parameters), (parameters.length, parameters.width))
    if nesting is None:
        free = nest(shapes, _wall(parameters))
        advice = "use fewer tools or thinner walls"
        if free is not None:
            sides = " by ".join(f"{1e3 * side:.0f}" for side in _block_sides(free))
            advice = f"use a block of {sides} mm"
        given = f"{1e3 * parameters.length:g} by {1e3 * parameters.width:g} mm"
        raise UserError(
            f"there is no room for {_quoted(tools)} on a block of {given} with walls of "
            f"{1e3 * _wall(parameters):g} mm: {advice}"
        )
    return nesting


def _quoted(tools: Sequence[Tool]) -> str:
    return ", ".join(f"'{tool.name}'" for tool in tools)


def released_fingers(tool: Tool) -> CrossSection:
    """Returns the outlines of the fingers as they release a tool at its annotated grasp.

    They are two rectangles, each from a gripped face outward, in T, in metres.
    """
    fingers = CrossSection()
    for side in (-1, 1):
        middle = side * (tool.grasp.width + RELEASE_REACH) / 2
        fingers += CrossSection.square((FINGER_LENGTH, RELEASE_REACH), True).translate((0, middle))
    return fingers.rotate(math.degrees(tool.grasp.theta)).translate((tool.grasp.x, tool.grasp.y))


def kit_cavities(
    tools: Sequence[Tool], parameters: KitParameters, poses: Sequence[CavityPose] | None = None
) -> list[Cavity]:
    """Returns the cavity of each tool, in the tools' order.

    Args:
        tools: the tools of the kit.
        parameters: the parameters of the kit.
        poses: the poses of the seated tools; by default those of `layout_kit`.

    Raises:
        UserError: the tools do not fit; see `layout_kit`.
    """
    poses = layout_kit(tools, parameters).poses if poses is None else poses
    return [
        Cavity(
            moved_outline(cavity_outline(tool.footprint, parameters.of_tool(tool.name)), pose),
            pose.z,
            parameters.height,
            parameters.lead_in,
        )
        for tool, pose in zip(tools, poses, strict=True)
    ]


def moved_outline(outline: CrossSection, pose: CavityPose) -> CrossSection:
    """Moves an outline from a seated tool's frame T to the kit frame K."""
    if pose.yaw:
        outline = outline.rotate(math.degrees(pose.yaw))
    return outline.translate((pose.x, pose.y))


def _has_walls(cavities: Sequence[Cavity], parameters: KitParameters) -> bool:
    """Whether the walls between cavities and beside the block's sides are thick enough."""
    half_wall = parameters.minimum_wall / 2
    grown = [
        cavity.rim.offset(half_wall, JoinType.Round, circular_segments=ARC_SEGMENTS)
        for cavity in cavities
    ]
    room = CrossSection.square((parameters.length, parameters.width), True)
    return all((outline - room).area() <= 1e-9 for outline in grown) and all(
        (one ^ other).area() <= 1e-9 for one, other in itertools.combinations(grown, 2)
    )
