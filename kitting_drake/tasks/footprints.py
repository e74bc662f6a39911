"""Draws poses on the table at which objects do not overlap and the open hand has room."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.tasks.task import TABLE
from systems.grasp import Grasp
from systems.hand_geometry import FINGER_DEPTH, FINGER_LENGTH, MAX_OPENING, PALM_SIZE
from systems.signals import PixelGrid

OPEN_FINGERS = (FINGER_LENGTH, MAX_OPENING + 2 * FINGER_DEPTH)
"""Size of a rectangle that covers the open fingers and the gap between them, seen from above: along
the pads and across them, in m."""

_TRIES = 200
_RESTARTS = 50

_Item = TypeVar("_Item")
_Found = TypeVar("_Found")

Polygon = NDArray[np.float64]
"""(n, 2) corners of a convex polygon, counter-clockwise, in metres."""


def rectangle(
    length: float, width: float, *, x: float = 0.0, y: float = 0.0, theta: float = 0.0
) -> Polygon:
    """A rectangle with its middle at (x, y), rotated by theta; in metres and radians."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (length / 2, width / 2)
    return _moved(corners, x, y, theta)


def disc(radius: float, *, sides: int = 16) -> Polygon:
    """A regular polygon around a disc whose middle is the origin; in metres."""
    angles = np.arange(sides) * math.tau / sides
    corners = radius / math.cos(math.pi / sides) * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(corners)


def separation(a: Polygon, b: Polygon) -> float:
    """Measures how far two convex polygons are apart.

    Returns:
        The widest gap between them along a normal of one of their sides, in metres. The gap never
        exceeds their distance, and is negative if and only if they overlap.
    """
    gaps = [
        ((corners @ normals.T).min(axis=0) - (own @ normals.T).max(axis=0)).max()
        for own, corners in ((a, b), (b, a))
        for normals in (_normals(own),)
    ]
    return float(max(gaps))


@dataclass(frozen=True)
class Footprint:
    """The part of the table that an object or fixture covers, in its own frame, in metres."""

    body: tuple[Polygon, ...]
    """Convex polygons that together make up the covered part."""
    grasps: tuple[Grasp, ...] = ()
    """Grasps at which the hand picks the object, or places an object on the fixture. The open
    fingers need free space at each of them."""
    tall: bool = False
    """Whether the object is so high, or will become so high, that the palm cannot pass over it."""

    @cached_property
    def fingers(self) -> tuple[Polygon, ...]:
        """For each grasp, one polygon that covers the open fingers and the gap between them."""
        return self._at_grasps(OPEN_FINGERS)

    @cached_property
    def palm(self) -> tuple[Polygon, ...]:
        """For each grasp, one polygon that covers the palm."""
        return self._at_grasps(PALM_SIZE)

    def moved(self, x: float, y: float, yaw: float) -> Placed:
        """The footprint at a pose on the table."""

        def move(polygons: tuple[Polygon, ...]) -> tuple[Polygon, ...]:
            return tuple(_moved(polygon, x, y, yaw) for polygon in polygons)

        return Placed(move(self.body), move(self.fingers), move(self.palm), self.tall)

    def _at_grasps(self, size: tuple[float, float]) -> tuple[Polygon, ...]:
        return tuple(rectangle(*size, x=g.x, y=g.y, theta=g.theta) for g in self.grasps)


@dataclass(frozen=True)
class Placed:
    """A footprint at a pose in the world."""

    body: tuple[Polygon, ...]
    fingers: tuple[Polygon, ...]
    palm: tuple[Polygon, ...]
    tall: bool

    def is_within(self, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
        """Whether the body is within the axis-aligned rectangle with the given corners."""
        return all(
            bool((polygon >= lower).all() and (polygon <= upper).all()) for polygon in self.body
        )

    def is_clear_of(self, other: Placed, spacing: float) -> bool:
        """Whether the bodies are at least `spacing` metres apart, and neither body obstructs the
        hand at a grasp of the other."""
        return (
            _are_apart(self.body, other.body, spacing)
            and _are_apart(self.fingers, other.body, 0.0)
            and _are_apart(self.body, other.fingers, 0.0)
            and not (other.tall and not _are_apart(self.palm, other.body, 0.0))
            and not (self.tall and not _are_apart(self.body, other.palm, 0.0))
        )


@dataclass(frozen=True)
class _Drawn:
    X_W: RigidTransform
    placed: Placed


def draw_poses(
    footprints: Sequence[Footprint],
    *,
    grid: PixelGrid,
    rng: np.random.Generator,
    spacing: float = 0.01,
) -> list[RigidTransform]:
    """Draws poses with any heading on the table, within the workspace.

    All bodies keep the spacing, and at each grasp the open hand touches only the grasped object.

    Args:
        footprints: the footprints of the bodies to place, in the order in which they are drawn. Put
            large ones first.
        grid: pixel grid of the workspace.
        rng: the generator of all random draws.
        spacing: least distance between two bodies, in metres.

    Returns:
        The pose in the world of each footprint.

    Raises:
        UserError: no free space was found.
    """
    lower = np.maximum((grid.x_min, grid.y_min), TABLE[0])
    upper = np.minimum((grid.x_max, grid.y_max), TABLE[1])

    def draw(footprint: Footprint, placed: list[_Drawn]) -> _Drawn | None:
        others = [drawn.placed for drawn in placed]
        return _draw_pose(footprint, others, lower, upper, rng, spacing)

    found = draw_in_turn(footprints, draw, restarts=_RESTARTS)
    if found is None:
        raise UserError(
            f"there is no free space in the workspace for the task's {len(footprints)} objects and "
            "fixtures: enlarge heightmap.rows and heightmap.cols"
        )
    return [drawn.X_W for drawn in found]


def draw_in_turn(
    items: Sequence[_Item],
    draw: Callable[[_Item, list[_Found]], _Found | None],
    *,
    restarts: int,
) -> list[_Found] | None:
    """Draws places for items one after another, and starts over if there is no place for an item.

    Args:
        items: the items to place, in the order in which they are drawn.
        draw: a function that returns a place for an item, given the places of earlier items; None
            if there is no place.
        restarts: largest number of attempts.

    Returns:
        The places, in the same order; None if all attempts failed.
    """
    for _ in range(restarts):
        placed: list[_Found] = []
        for item in items:
            found = draw(item, placed)
            if found is None:
                break
            placed.append(found)
        else:
            return placed
    return None


def _draw_pose(
    footprint: Footprint,
    placed: Sequence[Placed],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    rng: np.random.Generator,
    spacing: float,
) -> _Drawn | None:
    """Draws a free pose; None if none was found."""
    if (upper <= lower).any():
        return None
    for _ in range(_TRIES):
        x, y = (float(value) for value in rng.uniform(lower, upper))
        yaw = float(rng.uniform(-math.pi, math.pi))
        candidate = footprint.moved(x, y, yaw)
        if candidate.is_within(lower, upper) and all(
            candidate.is_clear_of(other, spacing) for other in placed
        ):
            return _Drawn(RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, 0]), candidate)
    return None


def _moved(polygon: Polygon, x: float, y: float, theta: float) -> Polygon:
    cos, sin = math.cos(theta), math.sin(theta)
    return polygon @ np.array([[cos, sin], [-sin, cos]]) + (x, y)


def _normals(polygon: Polygon) -> NDArray[np.float64]:
    sides = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([sides[:, 1], -sides[:, 0]])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _are_apart(a: Sequence[Polygon], b: Sequence[Polygon], distance: float) -> bool:
    return all(separation(one, other) >= distance for one in a for other in b)
