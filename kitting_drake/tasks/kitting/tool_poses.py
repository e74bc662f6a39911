"""Draws poses of kit and tools on the table, and checks given poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.footprints import OPEN_FINGERS, draw_in_turn
from kitting_drake.tasks.task import TABLE
from systems.bounds import bounded
from systems.hand_geometry import PALM_SIZE
from systems.signals import PixelGrid

_TRIES = 300
_RESTARTS = 60
_DISTRACTOR_SPACING = 0.01
"""Least distance of a drawn box from anything else, in metres."""
_MANY = 6
"""If there are more tools than this, the poses of large tools are drawn before those of small
ones."""


@dataclass
class TablePose:
    """A pose on the table."""

    # World x and y, in m.
    x: float = bounded(0.5, -2.0, 2.0)
    y: float = bounded(0.0, -2.0, 2.0)

    # Rotation about world z, counter-clockwise, in degrees.
    yaw_deg: float = bounded(0.0, -360.0, 360.0)

    def transform(self) -> RigidTransform:
        """The pose as a transform X_W in the world."""
        yaw = np.deg2rad(self.yaw_deg)
        return RigidTransform(RollPitchYaw(0, 0, yaw), [self.x, self.y, 0])


@dataclass(frozen=True)
class _Footprint:
    """The outlines, seen from above, of an object and of the open hand that grasps it."""

    outline: CrossSection
    fingers: CrossSection
    palm: CrossSection
    """The outline of the palm. At a grasp, the palm passes over other tools, but not over a kit."""

    def moved(self, pose: TablePose) -> "_Footprint":
        return _Footprint(
            *(
                shape.rotate(pose.yaw_deg).translate((pose.x, pose.y))
                for shape in (self.outline, self.fingers, self.palm)
            )
        )


_Drawn = tuple[TablePose, _Footprint]


def outline_at(outline: CrossSection, X_W: RigidTransform) -> CrossSection:
    """The outline, in the world, of an upright object at a pose on the table."""
    yaw = RollPitchYaw(X_W.rotation()).yaw_angle()
    return outline.rotate(math.degrees(yaw)).translate(tuple(X_W.translation()[:2]))


def block_outline(kit: Kit) -> CrossSection:
    """The outline of the kit block from above, in its frame, in metres."""
    return CrossSection.square(kit.size[:2], True)


def check_arrangement(
    kit: Kit, kit_pose: TablePose, tools: dict[str, tuple[Tool, TablePose]]
) -> None:
    """Checks that kit and tools are on the table and do not overlap.

    Args:
        kit: the kit.
        kit_pose: the kit's pose.
        tools: the tools and their poses, by the scenario's names.

    Raises:
        UserError: something is off the table, or two things overlap. The message names the fields.
    """
    table = _rectangle(*TABLE)
    placed: dict[str, CrossSection] = {}
    things = {"task.kit_pose": (block_outline(kit), kit_pose)}
    things |= {f"task.tools.{name}": (tool.footprint, pose) for name, (tool, pose) in tools.items()}
    for name, (outline, pose) in things.items():
        outline = outline.rotate(pose.yaw_deg).translate((pose.x, pose.y))
        if (outline - table).area() > 1e-9:
            (x_min, y_min), (x_max, y_max) = TABLE
            raise UserError(
                f"{name} extends beyond the table: keep all of it within x from {x_min:g} to "
                f"{x_max:g} m and y from {y_min:g} to {y_max:g} m"
            )
        for other, standing in placed.items():
            if _overlap(outline, standing):
                raise UserError(f"{other} and {name} overlap: move one of them")
        placed[name] = outline


def draw_poses(
    kit: Kit,
    tools: Sequence[Tool],
    *,
    grid: PixelGrid,
    spacing: float,
    yaw_range_deg: float,
    rng: np.random.Generator,
) -> tuple[RigidTransform, list[RigidTransform]]:
    """Draws poses of one kit and its tools. For the arguments see `draw_kit_poses`."""
    X_WKits, X_WTools = draw_kit_poses(
        [kit], tools, grid=grid, spacing=spacing, yaw_range_deg=yaw_range_deg, rng=rng
    )
    return X_WKits[0], X_WTools


def draw_kit_poses(
    kits: Sequence[Kit],
    tools: Sequence[Tool],
    *,
    grid: PixelGrid,
    spacing: float,
    yaw_range_deg: float,
    rng: np.random.Generator,
    margins: Sequence[float] = (),
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """Draws poses of kits and tools, within the workspace and on the table.

    Nothing overlaps, and the open hand at each tool's grasp touches no other tool and no kit.

    Args:
        kits: the kits.
        tools: the tools.
        grid: pixel grid of the workspace.
        spacing: least distance between any two kits or tools, in metres.
        yaw_range_deg: rotations are drawn within plus or minus this, in degrees.
        rng: the generator of all random draws.
        margins: how far each kit extends beyond its outline because it is tilted, in metres; zero
            by default.

    Returns:
        X_WKit of each kit, and X_WT of each tool.

    Raises:
        UserError: no free space was found.
    """
    seen = _rectangle((grid.x_min, grid.y_min), (grid.x_max, grid.y_max))
    room = seen ^ _rectangle(*TABLE)
    shapes = [
        _Footprint(_grown_block(kit, margin), CrossSection(), CrossSection())
        for kit, margin in zip(kits, margins or [0.0] * len(kits), strict=True)
    ]
    shapes += [_tool_footprint(tool) for tool in tools]
    order = list(range(len(shapes)))
    if len(tools) > _MANY:
        order.sort(key=lambda index: (index >= len(kits), -shapes[index].outline.area()))

    def draw(index: int, placed: list[_Drawn]) -> _Drawn | None:
        others = [footprint for _, footprint in placed]
        blocks = others[: len(kits)]
        return _draw_pose(shapes[index], others, blocks, room, grid, spacing, yaw_range_deg, rng)

    found = draw_in_turn(order, draw, restarts=_RESTARTS)
    if found is None:
        raise UserError(
            "there is no free space in the workspace for the "
            + ("kit" if len(kits) == 1 else f"{len(kits)} kits")
            + f" and {len(tools)} tools: "
            "enlarge heightmap.rows and heightmap.cols, or reduce task.spacing"
        )
    drawn = {index: pose for index, (pose, _) in zip(order, found, strict=True)}
    transforms = [drawn[index].transform() for index in range(len(shapes))]
    return transforms[: len(kits)], transforms[len(kits) :]


def _grown_block(kit: Kit, margin: float) -> CrossSection:
    """The outline of a kit block with a margin for its tilt, in the kit's frame, in metres."""
    length, width, _ = kit.size
    return CrossSection.square((length + 2 * margin, width + 2 * margin), True)


def _draw_pose(
    shape: _Footprint,
    placed: list[_Footprint],
    blocks: list[_Footprint],
    room: CrossSection,
    grid: PixelGrid,
    spacing: float,
    yaw_range_deg: float,
    rng: np.random.Generator,
) -> _Drawn | None:
    """Draws a free pose; None if none was found. `placed` must include the kit blocks."""
    for _ in range(_TRIES):
        x, y = rng.uniform((grid.x_min, grid.y_min), (grid.x_max, grid.y_max))
        pose = TablePose(x=x, y=y, yaw_deg=rng.uniform(-yaw_range_deg, yaw_range_deg))
        candidate = shape.moved(pose)
        if (candidate.outline - room).area() > 1e-9:
            continue
        grown = candidate.outline.offset(spacing, JoinType.Square)
        blocked = any(
            _overlap(grown, other.outline)
            or _overlap(candidate.fingers, other.outline)
            or _overlap(candidate.outline, other.fingers)
            for other in placed
        )
        if not blocked and not any(_overlap(candidate.palm, block.outline) for block in blocks):
            return pose, candidate
    return None


@dataclass(frozen=True)
class DrawnBox:
    """A random box on the table."""

    size: tuple[float, float, float]
    """Side lengths of the box, in metres."""
    colour: tuple[float, float, float]
    X_WB: RigidTransform
    """Pose in the world of the middle of the box's bottom."""


def draw_boxes(
    count: int,
    kits: Sequence[tuple[Kit, RigidTransform]],
    tools: Sequence[Tool],
    X_WTools: Sequence[RigidTransform],
    *,
    grid: PixelGrid,
    rng: np.random.Generator,
) -> list[DrawnBox]:
    """Draws boxes of random size and colour, for which the kits have no cavities.

    The boxes keep clear of the kits, the tools, and the hand at each grasp. If there is not enough
    room, there are fewer than `count`.

    Args:
        count: largest number of boxes.
        kits: the kits and their poses.
        tools: the tools.
        X_WTools: the poses of the tools in the world.
        grid: the workspace.
        rng: the generator of all random draws.
    """
    room = _rectangle((grid.x_min, grid.y_min), (grid.x_max, grid.y_max)) ^ _rectangle(*TABLE)
    placed = [
        _Footprint(block_outline(kit), CrossSection(), CrossSection()).moved(_pose(X_WKit))
        for kit, X_WKit in kits
    ]
    blocks = list(placed)
    placed += [
        _tool_footprint(tool).moved(_pose(X)) for tool, X in zip(tools, X_WTools, strict=True)
    ]
    boxes = []
    for _ in range(count):
        length, width, height = rng.uniform((0.015, 0.015, 0.008), (0.07, 0.07, 0.045)).tolist()
        red, green, blue = rng.uniform(0.05, 0.95, 3).tolist()
        outline = CrossSection.square((length, width), True)
        shape = _Footprint(outline, CrossSection(), CrossSection())
        found = _draw_pose(shape, placed, blocks, room, grid, _DISTRACTOR_SPACING, 180.0, rng)
        if found is None:
            continue
        pose, footprint = found
        placed.append(footprint)
        boxes.append(DrawnBox((length, width, height), (red, green, blue), pose.transform()))
    return boxes


def _pose(X: RigidTransform) -> TablePose:
    x, y, _ = X.translation()
    return TablePose(x=x, y=y, yaw_deg=float(np.rad2deg(RollPitchYaw(X.rotation()).yaw_angle())))


def _tool_footprint(tool: Tool) -> _Footprint:
    grasp = tool.grasp
    fingers, palm = (
        rectangle_at(size, grasp.x, grasp.y, grasp.theta) for size in (OPEN_FINGERS, PALM_SIZE)
    )
    # Use the convex hull, which contains the outline and has fewer vertices.
    return _Footprint(tool.footprint.hull(), fingers, palm)


def rectangle_at(size: tuple[float, float], x: float, y: float, theta: float) -> CrossSection:
    """A rectangle with its middle at (x, y), rotated by theta; in metres and radians."""
    return CrossSection.square(size, True).rotate(math.degrees(theta)).translate((x, y))


def _rectangle(lower: tuple[float, float], upper: tuple[float, float]) -> CrossSection:
    return CrossSection.square((upper[0] - lower[0], upper[1] - lower[1])).translate(lower)


def _overlap(a: CrossSection, b: CrossSection) -> bool:
    return (a ^ b).area() > 1e-9
