"""Draws starts of episodes in which tools touch, cross, lean on the kit, or lie in a heap.

Poses are drawn in groups (`start_groups`), the groups are placed on the table, and a simulation
lets the tools come to rest (`settling`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.footprints import draw_in_turn
from kitting_drake.tasks.kitting.settling import SettlingModel, Still, StillBlock, settle
from kitting_drake.tasks.kitting.start_checks import (
    FACES,
    TRAY,
    TRAY_SIZE,
    Start,
    StartCheck,
    surface_of_box,
)
from kitting_drake.tasks.kitting.start_groups import KIT, START_KINDS, Group, start_groups
from kitting_drake.tasks.task import TABLE, Fixture, Scene
from systems.grasp import Grasp
from systems.signals import PixelGrid

APART = "apart"
"""The kind of start in which tools lie apart. It needs no simulation."""

_TRAY_WALL, _TRAY_FLOOR = 0.004, 0.003
_REDRAWS = 200
"""A start is drawn and settled at most this many times."""
_TRIES, _RESTARTS = 200, 20


@dataclass(frozen=True)
class _Room:
    """Where groups of tools may lie: the workspace, their spacing and their rotations."""

    grid: PixelGrid
    spacing: float
    yaw_range: float
    """The largest rotation to either side, in rad."""

    @property
    def outline(self) -> CrossSection:
        (x_min, y_min), (x_max, y_max) = TABLE
        table = CrossSection.square((x_max - x_min, y_max - y_min)).translate((x_min, y_min))
        grid = self.grid
        seen = CrossSection.square((grid.x_max - grid.x_min, grid.y_max - grid.y_min))
        return seen.translate((grid.x_min, grid.y_min)) ^ table


def draw_start(
    kit: Kit,
    tools: Sequence[Tool],
    models: Sequence[SettlingModel],
    grasps: Sequence[Sequence[Grasp]],
    *,
    kind: str,
    tray: bool,
    faces: str,
    grid: PixelGrid,
    spacing: float,
    yaw_range_deg: float,
    rng: np.random.Generator,
    kit_model: bool = True,
) -> Start:
    """Draws poses of tools and kit, and lets the tools come to rest.

    A start is drawn again if a tool does not come to rest, leaves the workspace, the table or the
    tray, or lies on the kit block, or if the tools do not lie as `kind` requires.

    Args:
        kit: the kit.
        tools: the tools.
        models: the tools' models for the simulation, in the same order.
        grasps: the grasps of each tool, best first.
        kind: one of `START_KINDS`.
        tray: whether the tools lie in the tray `TRAY`.
        faces: with `as_drawn`, every tool rests on the face that is at the bottom in its cavity;
            with `any`, tools may come to rest on another face.
        grid: pixel grid of the workspace.
        spacing: least distance between groups of tools, and to the kit, in metres.
        yaw_range_deg: rotations are drawn within plus or minus this, in degrees.
        rng: the generator of all random draws.
        kit_model: whether the simulation uses the model of the kit's block. If not, it uses a box
            without cavities.

    Raises:
        UserError: no such start was found, or `kind` needs more tools.
    """
    if kind in ("touching", "crossed") and len(tools) < 2:
        raise UserError(f"task.start: '{kind}' needs at least two tools")
    room = _Room(grid, spacing, math.radians(yaw_range_deg))
    for _ in range(_REDRAWS):
        drawn = _draw(kit, tools, kind, tray, room, rng)
        if drawn is None:
            continue
        check = StartCheck(kit, tools, grasps, kind, faces, grid, drawn)
        if not check.may_settle(drawn.X_WTools):
            continue
        still: list[Still] = [
            (kit.sdf, drawn.X_WKit) if kit_model else StillBlock(kit.size, drawn.X_WKit)
        ]
        if drawn.X_WTray is not None:
            still.append((TRAY, drawn.X_WTray))
        settled = settle(models, drawn.X_WTools, still, goes_on=check.may_go_on)
        if settled is not None and check.is_good(settled):
            return Start(drawn.X_WKit, tuple(settled), drawn.X_WTray)
    raise UserError(
        f"task.start: no valid start '{kind}'{' in a tray' if tray else ''} with {len(tools)} "
        f"tools was found in {_REDRAWS} tries: enlarge heightmap.rows and heightmap.cols, or name "
        "fewer or shorter tools"
    )


def draw_unsettled(
    kit: Kit,
    tools: Sequence[Tool],
    *,
    kind: str,
    grid: PixelGrid,
    spacing: float,
    rng: np.random.Generator,
) -> Start:
    """Draws a start without a simulation.

    With the kinds `apart` and `touching`, the tools lie flat on the table. With the other kinds,
    they are not at rest. For the arguments see `draw_start`.

    Raises:
        UserError: there is no room.
    """
    drawn = _draw(kit, tools, kind, False, _Room(grid, spacing, math.pi), rng)
    if drawn is None:
        raise UserError(
            f"task.start: there is no room for {len(tools)} tools: name fewer or shorter tools"
        )
    return drawn


def check_start(start: str, tray: bool, faces: str, distractors: int) -> None:
    """Raises ValueError for unknown values and for invalid combinations."""
    for name, word, words in (("start", start, START_KINDS), ("faces", faces, FACES)):
        if word not in words:
            raise ValueError(f"task.{name} must be one of {', '.join(words)}, not '{word}'")
    if tray and start == "leaning":
        raise ValueError("task.tray must be false if task.start is leaning")
    if distractors and (tray or start != APART):
        raise ValueError(
            f"task.distractors must be 0, not {distractors}, unless task.start is apart and "
            "task.tray is false"
        )


def cluttered_scene(
    scene: Scene,
    kit: Kit,
    grasps: Sequence[tuple[Grasp, ...]],
    start: Start,
    grid: PixelGrid,
    max_actions: int,
) -> Scene:
    """Returns a scene in which the expert chooses among `grasps` and may lay tools aside.

    Args:
        scene: the scene to change, with the kit and its tools in the order in which the expert
            takes them.
        kit: the kit.
        grasps: the grasps of the scene's objects, best first.
        start: the poses at the start.
        grid: pixel grid of the workspace, in which tools are laid aside.
        max_actions: number of actions after which the episode ends.
    """
    (fixture,) = scene.fixtures
    fixtures = [replace(fixture, p_FPoints=surface_of_box(kit.size))]
    if start.X_WTray is not None:
        fixtures.append(Fixture("tray", TRAY, start.X_WTray, _tray_points()))
    lower = np.maximum((grid.x_min, grid.y_min), TABLE[0])
    upper = np.minimum((grid.x_max, grid.y_max), TABLE[1])
    objects = [replace(item, grasps=own) for item, own in zip(scene.objects, grasps, strict=True)]
    return replace(
        scene,
        objects=tuple(objects),
        fixtures=tuple(fixtures),
        max_actions=max_actions,
        laying_area=(tuple(lower.tolist()), tuple(upper.tolist())),
    )


def _tray_points() -> NDArray[np.float64]:
    """(m, 3) points of the tray's surface, in its frame."""
    length, width, height = TRAY_SIZE
    wall = _TRAY_WALL
    parts = [((length, width, _TRAY_FLOOR), (0.0, 0.0))]
    for sign in (-1, 1):
        parts.append(((wall, width, height), (sign * (length - wall) / 2, 0.0)))
        parts.append(((length, wall, height), (0.0, sign * (width - wall) / 2)))
    return np.concatenate([surface_of_box(size) + (x, y, 0.0) for size, (x, y) in parts])


def _draw(
    kit: Kit, tools: Sequence[Tool], kind: str, tray: bool, room: _Room, rng: np.random.Generator
) -> Start | None:
    """The poses before the tools come to rest; None if there is no room."""
    groups = start_groups(kit, tools, kind, rng)
    if not tray:
        placed = _place(groups, room.outline, room, rng)
        return None if placed is None else _start(groups, placed, len(tools), None)
    (kit_group,) = [group for group in groups if KIT in group.members]
    outline = CrossSection.square(TRAY_SIZE[:2], True)
    around = [kit_group, Group({}, outline)]
    both = _place(around, room.outline, room, rng)
    if both is None:
        return None
    X_WTray = both[1]
    inner = CrossSection.square([side - 2 * _TRAY_WALL for side in TRAY_SIZE[:2]], True)
    inside = [group for group in groups if group is not kit_group]
    within = _place(inside, inner, room, rng)
    if within is None:
        return None
    floor = RigidTransform([0.0, 0.0, _TRAY_FLOOR])
    placed = [both[0], *(X_WTray @ floor @ X for X in within)]
    return _start([kit_group, *inside], placed, len(tools), X_WTray)


def _start(
    groups: Sequence[Group],
    placed: Sequence[RigidTransform],
    count: int,
    X_WTray: RigidTransform | None,
) -> Start:
    poses = {
        index: X_WGroup @ X
        for group, X_WGroup in zip(groups, placed, strict=True)
        for index, X in group.members.items()
    }
    return Start(poses[KIT], tuple(poses[index] for index in range(count)), X_WTray)


def _place(
    groups: Sequence[Group], area: CrossSection, room: _Room, rng: np.random.Generator
) -> list[RigidTransform] | None:
    """Draws a pose in the world for each group; None if there is no room.

    The groups lie within `area`, at least `room.spacing` apart.
    """
    x_min, y_min, x_max, y_max = area.bounds()

    def draw(group: Group, placed: list[tuple[RigidTransform, CrossSection]]):
        for _ in range(_TRIES):
            x, y = rng.uniform((x_min, y_min), (x_max, y_max)).tolist()
            yaw = float(rng.uniform(-room.yaw_range, room.yaw_range))
            outline = group.outline.rotate(math.degrees(yaw)).translate((x, y))
            if (outline - area).area() > 1e-9:
                continue
            grown = outline.offset(room.spacing, JoinType.Square)
            if not any((grown ^ other).area() > 1e-9 for _, other in placed):
                return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, 0.0]), outline
        return None

    found = draw_in_turn(groups, draw, restarts=_RESTARTS)
    return None if found is None else [X for X, _ in found]
