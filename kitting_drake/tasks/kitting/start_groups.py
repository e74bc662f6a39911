"""Draws groups of tools that touch, cross, lean on the kit or fall into a heap, before they settle
in a simulation."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.tools.tool import Tool

KIT = -1
"""The key of the kit in `Group.members`."""

_GAP = 0.003
"""Largest gap between touching tools, in metres."""
_ALONGSIDE = 0.10
"""Largest shift of touching tools along each other, in metres."""
_SPLAY = math.radians(6.0)
"""Largest angle between the directions of touching tools, in radians."""
_CROSSING = (math.radians(50.0), math.radians(130.0))
"""Range of the angle between crossed tools, in radians."""
_CROSSING_SHARE = 0.2
"""Tools cross at most this far from each tool's middle, as a share of that tool's length."""
_LIFT = 0.002
"""Height from which a tool falls onto the one below it, in metres."""

_HEAP_RADIUS = 0.05
"""Tools of a heap fall from above a disc of this radius, in metres."""
_HEAP_REACH = 0.12
"""A heap needs a free disc of this radius, in metres."""
_HEAP_HEIGHT, _HEAP_STEP = 0.12, 0.03
"""The lowest tool of a heap falls from `_HEAP_HEIGHT`, in metres, and each further tool from
`_HEAP_STEP` higher."""
_HEAP_TILT = math.radians(15.0)
"""Largest roll and pitch of the tools of a heap before they fall, in radians."""

_LEAN_OVER = (0.008, 0.022)
"""Range of the length by which a leaning tool extends over the block's edge, in metres."""
_LEAN_SPLAY = math.radians(25.0)
"""Largest angle between a leaning tool and the normal of the block's side, in radians."""
_LEAN_CORNER = 0.04
"""Least distance of a leaning tool from the block's corners, in metres."""


@dataclass(frozen=True)
class Group:
    """Tools, and perhaps the kit, that are placed on the table together."""

    members: dict[int, RigidTransform]
    """Pose of each member in the group's frame, by the tool's index or `KIT`."""
    outline: CrossSection
    """The outline of the group, seen from above, in the group's frame, in metres."""


def start_groups(
    kit: Kit, tools: Sequence[Tool], kind: str, rng: np.random.Generator
) -> list[Group]:
    """Draws the groups of a start. The first group contains the kit.

    Args:
        kit: the kit.
        tools: the tools; each belongs to one group.
        kind: one of `START_KINDS`.
        rng: the generator of all random draws.
    """
    block = Group({KIT: RigidTransform()}, CrossSection.square(kit.size[:2], True))
    return [*GROUPS[kind](block, kit, tools, rng)]


def projected(points: NDArray[np.float64], X: RigidTransform) -> CrossSection:
    """The convex hull of points (n, 3) at a pose, seen from above, in metres."""
    return CrossSection.hull_points(np.ascontiguousarray(X.multiply(points.T)[:2].T))


def _corners(tool: Tool) -> NDArray[np.float64]:
    return tool.triangles.reshape(-1, 3)


def _alone(index: int, tool: Tool) -> Group:
    return Group({index: RigidTransform()}, tool.footprint.hull())


def _apart(block: Group, kit: Kit, tools: Sequence[Tool], rng: np.random.Generator) -> list[Group]:
    return [block, *(_alone(index, tool) for index, tool in enumerate(tools))]


def _paired(
    pair: Callable[[Tool, Tool, np.random.Generator], RigidTransform],
) -> Callable[..., list[Group]]:
    """Returns a function that makes groups of two tools. `pair` draws the pose of the second tool
    of a group relative to the first."""

    def draw(
        block: Group, kit: Kit, tools: Sequence[Tool], rng: np.random.Generator
    ) -> list[Group]:
        order = rng.permutation(len(tools)).tolist()
        groups = [block]
        for first, second in zip(order[::2], order[1::2], strict=False):
            X = pair(tools[first], tools[second], rng)
            members = {first: RigidTransform(), second: X}
            outline = tools[first].footprint.hull() + projected(_corners(tools[second]), X)
            groups.append(Group(members, outline))
        if len(order) % 2:
            groups.append(_alone(order[-1], tools[order[-1]]))
        return groups

    return draw


def _beside(tool: Tool, other: Tool, rng: np.random.Generator) -> RigidTransform:
    """Draws the pose of a tool beside another one, with a small gap."""
    yaw = float(rng.uniform(-_SPLAY, _SPLAY)) + math.pi * int(rng.integers(2))
    along, gap = float(rng.uniform(-_ALONGSIDE, _ALONGSIDE)), float(rng.uniform(0.0, _GAP))
    grown = tool.footprint.offset(gap, JoinType.Round, circular_segments=32)
    turned = other.footprint.rotate(math.degrees(yaw))
    step = 0.0005
    across = (tool.width + other.length) / 2
    side = 1 if rng.random() < 0.5 else -1
    while (grown ^ turned.translate((along, side * across))).area() < 1e-9 and across > 0:
        across -= step
    return RigidTransform(RollPitchYaw(0, 0, yaw), [along, side * (across + step), 0.0])


def _across(tool: Tool, other: Tool, rng: np.random.Generator) -> RigidTransform:
    """Draws the pose of a tool that lies across another one."""
    yaw = float(rng.uniform(*_CROSSING)) + math.pi * int(rng.integers(2))
    share, other_share = rng.uniform(-_CROSSING_SHARE, _CROSSING_SHARE, 2).tolist()
    x = share * tool.length - other_share * other.length * math.cos(yaw)
    y = -other_share * other.length * math.sin(yaw)
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, tool.height + _LIFT])


def _heap(block: Group, kit: Kit, tools: Sequence[Tool], rng: np.random.Generator) -> list[Group]:
    """Puts all tools above a disc, one above another, so that they fall into a heap."""
    members = {}
    for step, index in enumerate(rng.permutation(len(tools)).tolist()):
        radius = _HEAP_RADIUS * math.sqrt(float(rng.random()))
        angle, yaw = rng.uniform(-math.pi, math.pi, 2).tolist()
        roll, pitch = rng.uniform(-_HEAP_TILT, _HEAP_TILT, 2).tolist()
        members[index] = RigidTransform(
            RollPitchYaw(roll, pitch, yaw),
            [
                radius * math.cos(angle),
                radius * math.sin(angle),
                _HEAP_HEIGHT + step * _HEAP_STEP,
            ],
        )
    return [block, Group(members, CrossSection.circle(_HEAP_REACH, 32))]


def _leaning(
    block: Group, kit: Kit, tools: Sequence[Tool], rng: np.random.Generator
) -> list[Group]:
    """Lets half of the tools, at most four, each lean on a side of the block. The others lie
    apart."""
    order = rng.permutation(len(tools)).tolist()
    leaning = order[: (len(order) + 1) // 2]
    sides = rng.permutation(4).tolist()
    members, outline = dict(block.members), block.outline
    for index, side in zip(leaning, sides, strict=False):
        members[index] = _lean(kit, tools[index], side, rng)
        outline = outline + projected(_corners(tools[index]), members[index])
    rest = [index for index in range(len(tools)) if index not in members]
    return [Group(members, outline), *(_alone(index, tools[index]) for index in rest)]


def _lean(kit: Kit, tool: Tool, side: int, rng: np.random.Generator) -> RigidTransform:
    """X_KT, the pose of a tool in the kit's frame, with one end on the table and the other on an
    upper edge of the block.

    Args:
        kit: the kit.
        tool: the tool.
        side: number of the block's side. Its normal is the x axis of K, rotated by this many
            quarter turns.
        rng: the generator of all random draws.
    """
    length, width, height = kit.size
    half, other_half = (length / 2, width / 2) if side % 2 == 0 else (width / 2, length / 2)
    room = max(other_half - _LEAN_CORNER, 0.0)
    along = float(rng.uniform(-room, room))
    splay, over = float(rng.uniform(-_LEAN_SPLAY, _LEAN_SPLAY)), float(rng.uniform(*_LEAN_OVER))
    over = min(over, tool.length / 3)  # At most a third of the tool extends over the edge.
    leads = bool(rng.integers(2))
    # Distance along the tool from the end on the table to the block's edge.
    reach = tool.length - over
    pitch = math.asin(min(height / reach, 0.9))
    # In the frame of the side, x is the normal, and the tool points along -x.
    heading = math.pi + splay
    toward = np.array([math.cos(heading), math.sin(heading)])
    foot = np.array([half, along]) - reach * math.cos(pitch) * toward
    middle = foot + tool.length / 2 * math.cos(pitch) * toward
    z = tool.length / 2 * math.sin(pitch) + _LIFT
    R = RollPitchYaw(0, -pitch, heading) if leads else RollPitchYaw(0, pitch, heading + math.pi)
    X_SideTool = RigidTransform(R, [*middle, z])
    return RigidTransform(RollPitchYaw(0, 0, side * math.pi / 2), [0, 0, 0]) @ X_SideTool


GROUPS: dict[str, Callable[..., list[Group]]] = {
    "apart": _apart,
    "touching": _paired(_beside),
    "crossed": _paired(_across),
    "leaning": _leaning,
    "heap": _heap,
}
"""The function that draws the groups, for each kind of start."""
START_KINDS = tuple(GROUPS)
"""The kinds of starts: the ways in which tools may lie."""
