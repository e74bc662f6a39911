"""Kitting: hand tools on a table, and a block with a cavity for each (section IV)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.hkd.tools.toolsets import toolsets
from kitting_drake.scenario.schema import ArrangedKitting, Kitting, Placement, ToolsetKitting
from systems.signals import PixelGrid

# What the open hand covers, seen from above with the jaws closing along y: (x, y) half sizes in m.
_FINGERS = (0.0104, 0.0663)
_PALM = (0.032, 0.1045)
"""The palm is 46 mm above the fingertips: above every tool, but not above a kit block."""

TABLE = ((0.0, -0.75), (1.0, 0.75))
"""Lower and upper (x, y) corner of the table in the world, in m."""

_TRIES = 300
_RESTARTS = 60


@dataclass(frozen=True)
class KittingScene:
    """One episode's beginning and its goals."""

    tools: tuple[Tool, ...]
    """In the order in which an oracle takes them."""
    kit: Kit
    X_WKit: RigidTransform
    X_WTools: tuple[RigidTransform, ...]
    """Initial poses of the tools' frames."""
    X_WGoals: tuple[RigidTransform, ...]
    """Poses of the seated tools."""
    success_threshold: float
    """ADD-S below this is a success, in metres."""


def make_scene(
    task: Kitting | ToolsetKitting | ArrangedKitting, *, grid: PixelGrid, seed: int, base: Path
) -> KittingScene:
    """Sets the table.

    Args:
        task: what stands on it.
        grid: the workspace. What is drawn lies whole in it, and on the table.
        seed: of the poses and of the order. The same seed gives the same scene.
        base: where relative paths of tools start.

    Raises:
        UserError: an unknown tool, tools that make no kit, no free space for them all, or an
            arrangement beside the table or of things within each other.
    """
    try:
        tools = [load_tool(name, base) for name in _tool_names(task, seed)]
        kit = make_kit(tools, task.kit)
    except UserError as error:
        raise UserError(f"task.tools: {error}") from error
    if isinstance(task, ArrangedKitting):
        X_WKit = _pose(task.kit_pose)
        X_WTools = [_pose(placement) for placement in task.tools.values()]
        _check_arrangement(task, kit, tools)
        order = np.arange(len(tools))
    else:
        rng = np.random.default_rng(seed)
        X_WKit, X_WTools = _draw_poses(task, kit, tools, grid, rng)
        order = rng.permutation(len(tools)) if task.random_order else np.arange(len(tools))
    X_WGoals = [X_WKit @ RigidTransform(kit.goal(index)) for index in range(len(tools))]
    return KittingScene(
        tools=tuple(tools[index] for index in order),
        kit=kit,
        X_WKit=X_WKit,
        X_WTools=tuple(X_WTools[index] for index in order),
        X_WGoals=tuple(X_WGoals[index] for index in order),
        success_threshold=task.success_threshold,
    )


def _tool_names(task: Kitting | ToolsetKitting | ArrangedKitting, seed: int) -> list[str]:
    if not isinstance(task, ToolsetKitting):
        return list(task.tools)
    choices = toolsets(task.split)
    # A stream of its own: the poses of a seed do not depend on how many toolsets there are.
    return list(choices[np.random.default_rng([seed, 1]).integers(len(choices))])


def _pose(placement: Placement) -> RigidTransform:
    yaw = np.deg2rad(placement.yaw_deg)
    return RigidTransform(RollPitchYaw(0, 0, yaw), [placement.x, placement.y, 0])


def _rectangle(lower: tuple[float, float], upper: tuple[float, float]) -> CrossSection:
    return CrossSection.square((upper[0] - lower[0], upper[1] - lower[1])).translate(lower)


def _block(kit: Kit) -> CrossSection:
    return CrossSection.square((kit.parameters.length, kit.parameters.width), True)


def _check_arrangement(task: ArrangedKitting, kit: Kit, tools: list[Tool]) -> None:
    table = _rectangle(*TABLE)
    placed: dict[str, CrossSection] = {}
    placements = [task.kit_pose, *task.tools.values()]
    outlines = [_block(kit), *(tool.silhouette for tool in tools)]
    names = ["task.kit_pose", *(f"task.tools.{name}" for name in task.tools)]
    for name, placement, outline in zip(names, placements, outlines, strict=True):
        outline = outline.rotate(placement.yaw_deg).translate((placement.x, placement.y))
        if (outline - table).area() > 1e-9:
            (x_min, y_min), (x_max, y_max) = TABLE
            raise UserError(
                f"{name} is not whole on the table, which is x from {x_min:g} to {x_max:g} m and "
                f"y from {y_min:g} to {y_max:g} m"
            )
        for other, standing in placed.items():
            if _overlap(outline, standing):
                raise UserError(f"{other} and {name} are within each other")
        placed[name] = outline


def _draw_poses(
    task: Kitting | ToolsetKitting,
    kit: Kit,
    tools: list[Tool],
    grid: PixelGrid,
    rng: np.random.Generator,
) -> tuple[RigidTransform, list[RigidTransform]]:
    """Poses of the kit and the tools, on the table, without collision.

    Besides the spacing between them, every tool can be reached: the open hand at its grasp touches
    no other tool and no kit.
    """
    seen = _rectangle((grid.x_min, grid.y_min), (grid.x_max, grid.y_max))
    room = seen ^ _rectangle(*TABLE)
    shapes = [_Shape(_block(kit), CrossSection(), CrossSection())]
    shapes += [_tool_shape(tool) for tool in tools]
    for _ in range(_RESTARTS):
        poses: list[RigidTransform] = []
        placed: list[_Shape] = []
        for shape in shapes:
            for _ in range(_TRIES):
                x, y = rng.uniform((grid.x_min, grid.y_min), (grid.x_max, grid.y_max))
                yaw_deg = rng.uniform(-task.yaw_range_deg, task.yaw_range_deg)
                candidate = shape.moved(x, y, yaw_deg)
                if (candidate.outline - room).area() > 1e-9:
                    continue
                grown = candidate.outline.offset(task.spacing, JoinType.Square)
                if not any(
                    _overlap(grown, other.outline)
                    or _overlap(candidate.fingers, other.outline)
                    or _overlap(candidate.outline, other.fingers)
                    for other in placed
                ) and not (placed and _overlap(candidate.palm, placed[0].outline)):
                    poses.append(_pose(Placement(x=x, y=y, yaw_deg=yaw_deg)))
                    placed.append(candidate)
                    break
            else:
                break
        if len(poses) == len(shapes):
            return poses[0], poses[1:]
    raise UserError(
        f"there is no free space in the workspace for the kit and {len(tools)} tools: "
        "enlarge heightmap.rows and heightmap.cols, or lessen task.spacing"
    )


@dataclass(frozen=True)
class _Shape:
    """Outlines on the table: of a thing, and of the open hand that grasps it."""

    outline: CrossSection
    fingers: CrossSection
    palm: CrossSection

    def moved(self, x: float, y: float, yaw_deg: float) -> "_Shape":
        return _Shape(
            *(
                shape.rotate(yaw_deg).translate((x, y))
                for shape in (self.outline, self.fingers, self.palm)
            )
        )


def _tool_shape(tool: Tool) -> _Shape:
    def at_grasp(half_sizes: tuple[float, float]) -> CrossSection:
        rectangle = CrossSection.square((2 * half_sizes[0], 2 * half_sizes[1]), True)
        return rectangle.rotate(np.rad2deg(tool.grasp.theta)).translate(
            (tool.grasp.x, tool.grasp.y)
        )

    # The hull is coarser than the outline and never smaller.
    return _Shape(tool.silhouette.hull(), at_grasp(_FINGERS), at_grasp(_PALM))


def _overlap(a: CrossSection, b: CrossSection) -> bool:
    return (a ^ b).area() > 1e-9
