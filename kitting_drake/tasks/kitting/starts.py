"""Draws how the tools lie at the start: touching, crossed, leaning on the kit, or in a heap.

Poses are drawn in groups (`start_groups`), the groups are placed on the table, and physics lets the
tools come to rest (`settling`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.grasps.all_grasps import all_grasps
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.boxes import box_points
from kitting_drake.tasks.footprints import draw_in_turn
from kitting_drake.tasks.kitting.settling import SettlingModel, Still, StillBlock, settle
from kitting_drake.tasks.kitting.start_groups import KIT, Group, projected, start_groups
from kitting_drake.tasks.task import TABLE, Fixture, Scene
from systems.signals import PixelGrid

APART = "apart"
FACES = ("as_drawn", "any")
TRAY = MODELS / "tray" / "tray.sdf"
"""The model of the tray."""
TRAY_SIZE = (0.380, 0.290, 0.020)
"""Outer extents along x, y and z of the tray's frame, whose origin is the middle of its bottom."""
_TRAY_WALL, _TRAY_FLOOR = 0.004, 0.003

_REDRAWS = 40
"""How often a start is drawn and settled again."""
_TRIES, _RESTARTS = 200, 20
_UPRIGHT = math.cos(math.radians(60.0))
"""A tool tilted further lies on another face than the one that was drawn."""
_ON_KIT = 0.002
"""A point this far inside the block's outline is on the kit, in metres."""
_LEANS = math.radians(5.0)
"""A tool tilted further leans."""


@dataclass(frozen=True)
class Start:
    """The poses at the start of an episode, at rest."""

    X_WKit: RigidTransform
    X_WTools: tuple[RigidTransform, ...]
    X_WTray: RigidTransform | None
    """None without a tray."""


@dataclass(frozen=True)
class _Room:
    """Where the tools' outlines may be."""

    grid: PixelGrid
    spacing: float
    yaw_range: float
    """In rad."""

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
    """Draws how the tools lie, and lets them come to rest.

    A start is drawn again if a tool does not come to rest, leaves the workspace, the table or the
    tray, lies on the kit block, or does not lie as its kind says.

    Args:
        kit: the kit.
        tools: the tools.
        models: their models for the physics, in the same order.
        kind: one of `START_KINDS`.
        tray: whether the tools lie in a tray. It is `TRAY`.
        faces: `as_drawn`, every tool rests on the face that lies down in its cavity; `any`, tools
            may come to rest on another one.
        grid: the workspace.
        spacing: least distance between groups of tools, and to the kit, in metres.
        yaw_range_deg: rotations are drawn within plus or minus this, in degrees.
        rng: the random generator of all draws.
        kit_model: whether the kit's block is its model; else a box without cavities.

    Raises:
        UserError: no such start was found.
    """
    if kind in ("touching", "crossed") and len(tools) < 2:
        raise UserError(f"task.start: '{kind}' needs at least two tools")
    if tray and kind == "leaning":
        raise UserError("task.start: tools in a tray cannot lean on the kit: set task.tray: false")
    room = _Room(grid, spacing, math.radians(yaw_range_deg))
    for _ in range(_REDRAWS):
        drawn = _draw(kit, tools, kind, tray, room, rng)
        if drawn is None:
            continue
        check = _Check(kit, tools, kind, faces, room, drawn)
        still: list[Still] = [
            (kit.sdf, drawn.X_WKit) if kit_model else StillBlock(kit.size, drawn.X_WKit)
        ]
        if drawn.X_WTray is not None:
            still.append((TRAY, drawn.X_WTray))
        settled = settle(models, drawn.X_WTools, still, goes_on=check.may_go_on)
        if settled is not None and check.is_good(settled):
            return Start(drawn.X_WKit, tuple(settled), drawn.X_WTray)
    raise UserError(
        f"task.start: no start '{kind}'{' in a tray' if tray else ''} of {len(tools)} tools was "
        f"found in {_REDRAWS} draws: enlarge heightmap.rows and heightmap.cols, or name fewer or "
        "shorter tools"
    )


def cluttered_scene(
    scene: Scene,
    kit: Kit,
    tools: Sequence[Tool],
    start: Start,
    grid: PixelGrid,
    max_actions: int,
) -> Scene:
    """A scene whose expert chooses among many grasps and may lay tools aside.

    Args:
        scene: of the kit and its tools, in the expert's order.
        kit: the kit.
        tools: the tools of the scene's objects.
        start: the poses.
        grid: the workspace; tools are laid aside in it.
        max_actions: the episode ends after this many.
    """
    (fixture,) = scene.fixtures
    fixtures = [replace(fixture, p_FPoints=_box_points(kit.size))]
    if start.X_WTray is not None:
        fixtures.append(Fixture("tray", TRAY, start.X_WTray, _tray_points()))
    lower = np.maximum((grid.x_min, grid.y_min), TABLE[0])
    upper = np.minimum((grid.x_max, grid.y_max), TABLE[1])
    objects = [
        replace(item, grasps=all_grasps(tool))
        for item, tool in zip(scene.objects, tools, strict=True)
    ]
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
    return np.concatenate([_box_points(size) + (x, y, 0.0) for size, (x, y) in parts])


def _box_points(size: Sequence[float]) -> NDArray[np.float64]:
    length, width, height = size
    return box_points((length, width, height))


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
    groups: Sequence[Group], placed: Sequence[RigidTransform], count: int, X_WTray: RigidTransform | None
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
    """X_W of each group: within the area, at a distance from each other. None: no room."""
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


class _Check:
    """Whether settled tools lie as they should."""

    def __init__(
        self, kit: Kit, tools: Sequence[Tool], kind: str, faces: str, room: _Room, drawn: Start
    ) -> None:
        self._kind, self._faces, self._drawn = kind, faces, drawn
        self._points = [np.unique(tool.triangles.reshape(-1, 3), axis=0) for tool in tools]
        self._kit_half = np.array(kit.size[:2]) / 2 - _ON_KIT
        self._grid = room.grid
        self._leaning = {
            index
            for index, X in enumerate(drawn.X_WTools)
            if kind == "leaning" and _tilt(X) > _LEANS
        }

    def may_go_on(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether the origins of all tools are still in the workspace and off the kit."""
        for index, X in enumerate(X_WTools):
            p_W = X.translation()
            on_kit = np.abs((self._drawn.X_WKit.inverse() @ p_W)[:2]) < self._kit_half
            if not self._grid.contains(p_W[:2]) or on_kit.all() or p_W[2] < -0.02:
                return False
        return True

    def is_good(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether the tools at rest make a start of this kind."""
        (x_low, y_low), (x_high, y_high) = TABLE
        X_KW = self._drawn.X_WKit.inverse()
        for index, (points, X) in enumerate(zip(self._points, X_WTools, strict=True)):
            p_W = X.multiply(points.T)
            inside = self._grid.contains(p_W[:2].T).all()
            inside &= bool((p_W[0] > x_low).all() and (p_W[0] < x_high).all())
            inside &= bool((p_W[1] > y_low).all() and (p_W[1] < y_high).all())
            p_K = X_KW.multiply(p_W)[:2]
            on_kit = (np.abs(p_K) < self._kit_half[:, None]).all(axis=0).any()
            if not inside or (on_kit and index not in self._leaning):
                return False
            if self._faces == FACES[0] and X.rotation().matrix()[2, 2] < _UPRIGHT:
                return False
        return self._is_in_tray(X_WTools) and self._is_of_kind(X_WTools)

    def _is_in_tray(self, X_WTools: Sequence[RigidTransform]) -> bool:
        if self._drawn.X_WTray is None:
            return True
        half = np.array(TRAY_SIZE[:2]) / 2
        X_TW = self._drawn.X_WTray.inverse()
        return all(
            bool((np.abs((X_TW @ X).multiply(points.T)[:2]) < half[:, None]).all())
            for points, X in zip(self._points, X_WTools, strict=True)
        )

    def _is_of_kind(self, X_WTools: Sequence[RigidTransform]) -> bool:
        if self._kind == "leaning":
            return all(_tilt(X_WTools[index]) > _LEANS for index in self._leaning)
        if self._kind in ("crossed", "heap"):
            outlines = [
                projected(points, X) for points, X in zip(self._points, X_WTools, strict=True)
            ]
            pairs = [
                (i, j)
                for j in range(len(outlines))
                for i in range(j)
                if (outlines[i] ^ outlines[j]).area() > 1e-5
            ]
            return len(pairs) >= (len(outlines) // 2 if self._kind == "crossed" else 1)
        return True


def _tilt(X: RigidTransform) -> float:
    """The angle between body z and world z, in rad."""
    return math.acos(np.clip(X.rotation().matrix()[2, 2], -1.0, 1.0))
