"""Makes the scene of kits and their tools."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.hkd.grasps.all_grasps import carrying_grasps
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.kits.layout import cavity_outline
from kitting_drake.hkd.kits.seating import find_seat
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.task import Fixture, Scene, SceneObject
from systems.placement import Goal, is_tilted
from systems.success import AddS

_SURFACE_POINTS = 2000


@dataclass(frozen=True)
class PosedKit:
    """A kit at a pose, and the tools that belong to it."""

    kit: Kit
    X_WKit: RigidTransform
    members: tuple[int, ...]
    """Indices of the kit's tools among the task's tools."""
    riser: Fixture | None = None
    """The riser under the kit; None if there is none."""


def kitting_scene(
    kits: Sequence[PosedKit],
    tools: Sequence[Tool],
    X_WTools: Sequence[RigidTransform],
    order: Sequence[int] | np.ndarray,
    threshold: float,
) -> Scene:
    """Makes the scene of kits and their tools, with a goal for each cavity.

    Identical tools may fill each other's cavities, in any kit.

    Args:
        kits: the kits; each tool belongs to one of them.
        tools: the tools.
        X_WTools: the initial pose of each tool.
        order: indices of the tools in the order in which the expert takes them.
        threshold: largest ADD-S of a success, in metres.
    """
    sorted_tools = [tools[index] for index in order]
    fixtures = (
        *(
            Fixture("kit" if n == 1 else f"kit_{n}", posed.kit.sdf, posed.X_WKit)
            for n, posed in enumerate(kits, start=1)
        ),
        *(posed.riser for posed in kits if posed.riser is not None),
    )
    names = _unique_names(sorted_tools, {fixture.name for fixture in fixtures})
    place = {
        tool: (number, slot)
        for number, posed in enumerate(kits)
        for slot, tool in enumerate(posed.members)
    }
    goals = []
    for name, tool, index in zip(names, sorted_tools, order, strict=True):
        number, slot = place[int(index)]
        alike = tuple(i for i, other in enumerate(sorted_tools) if _are_alike(tool, other))
        goal = _goal(name, kits[number], number, slot, alike, 1 / len(tools))
        kit = kits[number].kit
        if kit.tools[slot] is not tool:
            goal = dataclasses.replace(goal, poses=(goal.poses[0] @ _seat(tool, kit, slot),))
        goals.append(goal)
    return Scene(
        objects=tuple(
            SceneObject(
                name=name,
                category=tool.category,
                model=tool.sdf,
                X_WB=X_WTools[index],
                p_BPoints=tool.surface_points(_SURFACE_POINTS),
                grasps=carrying_grasps(tool),
                symmetry=tool.symmetry,
                axis=tool.axis,
            )
            for name, tool, index in zip(names, sorted_tools, order, strict=True)
        ),
        fixtures=fixtures,
        goals=tuple(goals),
        success=AddS(threshold),
        max_actions=len(tools),
    )


def _goal(
    name: str, posed: PosedKit, number: int, slot: int, alike: tuple[int, ...], reward: float
) -> Goal:
    pose, X_WKit = posed.kit.goal(slot), posed.X_WKit
    length, width, height = posed.kit.size
    rim, highest = float(X_WKit.translation()[2]) + height, None
    if is_tilted(X_WKit):
        rim = float((X_WKit @ np.array([pose.x, pose.y, height]))[2])
        corners = [
            X_WKit @ np.array([x * length, y * width, height])
            for x in (-0.5, 0.5)
            for y in (-0.5, 0.5)
        ]
        highest = float(max(corner[2] for corner in corners))
    X_KGoal = RigidTransform(RollPitchYaw(0, 0, pose.yaw), [pose.x, pose.y, pose.z])
    return Goal(
        name=f"cavity of {name}",
        objects=alike,
        poses=(X_WKit @ X_KGoal,),
        reward=reward,
        any_heading=posed.kit.tools[slot].is_round,
        rim_height=rim,
        highest=highest,
        fixture=number,
    )


def _seat(tool: Tool, kit: Kit, slot: int) -> RigidTransform:
    """The pose at which a tool is seated in the cavity of a slot, in the frame of the tool for
    which the cavity was made. The two tools may differ."""
    model = kit.tools[slot]
    cavity = cavity_outline(model.footprint, kit.parameters.of_tool(model.name))
    seat = find_seat(tool.footprint, model.footprint, cavity)
    return RigidTransform(RollPitchYaw(0, 0, seat.yaw), [seat.x, seat.y, 0])


def _are_alike(tool: Tool, other: Tool) -> bool:
    return tool.directory == other.directory and tool.length == other.length


def _unique_names(tools: Sequence[Tool], taken: set[str]) -> list[str]:
    names: list[str] = []
    for tool in tools:
        name, number = tool.name, 2
        # Avoid the names of other bodies in the scene.
        while name in names or name in taken or re.fullmatch(r"distractor_\d+", name):
            name, number = f"{tool.name}_{number}", number + 1
        names.append(name)
    return names
