"""Finds, from true poses, which objects lie on others and which grasps are unobstructed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from systems.free_area import find_free_pose
from systems.grasp import Grasp
from systems.hand_geometry import (
    FINGER_DEPTH,
    FINGER_LENGTH,
    FINGERTIP_DEPTH,
    PAD_LENGTH,
    PALM_HEIGHT,
    PALM_SIZE,
)
from systems.jaw_motion import ROOM
from systems.ledge import Ledge, moved_gripper
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.placement import PlacedObject, heading
from systems.signals import PlanarPose, SurfaceHeights

Points = NDArray[np.float64]

_CELL = 0.004
"""Side of the squares in which the heights of objects are compared, in metres."""
_ABOVE = 0.002
"""In a square, an object counts as above another one if its lowest point is higher than the other's
highest point, or lower by less than this, in metres."""
_LEAST_SQUARES = 2
"""An object lies on another one if it counts as above the other in at least this many squares."""
_FLAT = math.radians(2.5)
"""An object tilted by less than this, in radians, lies flat."""
_SAME_SHAPE = 0.0003
"""Two surfaces count as equal if the mean distance between their points is less than this, in
metres, plus 1.1 times the spacing of the points."""
_ROLLED = math.radians(20.0)
"""Only a tilt of at least this, in radians, counts as caused by rolling."""
_ROLLED_PITCH = math.radians(10.0)
"""The axis about which a round object rolls is assumed to deviate by less than this, in radians,
from x of its frame B."""
_UPSIDE_DOWN = math.radians(120.0)
"""An object tilted by more than this, in radians, lies upside down."""
_ON_EDGE = math.radians(60.0)
"""An object tilted by more than this, in radians, stands on its edge unless it lies upside down."""
_ALONG_EDGE = (0.0, 0.02, -0.02, 0.04, -0.04)
"""Where an object that stands on its edge is gripped: distances from its centre along its length,
in metres."""
_STEEPEST = math.radians(25.0)
"""The jaws cannot hold faces that are tilted by more than this, in radians, from the vertical."""
_SLENDER = 0.020
"""Height of a finger's slender tip, in metres."""
_PALM_ROOM = PALM_HEIGHT - 0.002
"""Height of the palm above the fingertips, less a margin that is smaller than the room that
`motion_heights` leaves, in metres."""
_MARGIN = 0.001
"""Least clearance between a finger and other objects, in metres."""
_SAME_PLACE, _SAME_ANGLE = 0.006, math.radians(15.0)
"""A grasp that differs from a failed one by less than this, in metres and radians, counts as the
same."""


@dataclass(frozen=True)
class HeldFromAbove:
    """A grasp of an object that may lie tilted."""

    grasp: Grasp
    gripper: PlanarPose
    """The gripper's pose in the world."""
    top: float
    """World z of the top of the part between the pads, in metres."""
    bottom: float
    """World z of the underside of the part between the pads, in metres."""
    lowest: float
    """World z of the whole object's lowest point, in metres."""
    obstruction: int
    """Number of surface points of other things that are in the way of the open hand."""
    below_palm: float = -math.inf
    """World z of the highest surface point below the palm, in metres."""
    width: float = math.inf
    """How wide the jaws must open, in metres; infinite if they may open fully."""

    def heights(self, highest: float, rim: float) -> SurfaceHeights:
        """The surface heights that the planner needs for this grasp.

        Args:
            highest: world z of the highest surface in the workspace, in metres.
            rim: world z of the rim around the place, in metres; 0 for a place on the table.
        """
        # Add how far the object reaches below its gripped part.
        highest += self.bottom - self.lowest
        return SurfaceHeights(
            pick_top=self.top,
            support=self.bottom,
            place_rim=rim,
            near_pick=highest,
            near_place=highest,
            highest=highest,
            below_palm=self.below_palm,
            width=self.width,
        )


@dataclass(frozen=True)
class ClutteredTable:
    """The objects on a table, the fixed things among them, and the hand that picks them."""

    objects: Sequence[PlacedObject]
    grasps: Sequence[Sequence[Grasp]]
    """The grasps of each object, best first."""
    area: tuple[tuple[float, float], tuple[float, float]]
    """The part of the table where objects may be laid aside: its lower and upper (x, y) corners in
    the world, in metres."""
    fixtures: Sequence[Points] = ()
    """For each thing that never moves, points (m, 3) of its surface in the world, in metres."""
    planner: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    ledge: Ledge | None = None
    """A block over whose edges the hand can tip objects to turn them over."""

    def points(self, poses: Sequence[RigidTransform]) -> list[Points]:
        """For each object, points (m, 3) of its surface in the world, in metres."""
        return [
            X_WB.multiply(item.p_BPoints.T).T
            for item, X_WB in zip(self.objects, poses, strict=True)
        ]

    def covered(self, points: Sequence[Points]) -> list[set[int]]:
        """For each object, the indices of the objects that lie on it."""
        squares = [_squares(item) for item in points]
        return [
            {
                other
                for other, above in enumerate(squares)
                if other != index and _is_on(above, below)
            }
            for index, below in enumerate(squares)
        ]

    def flat_heading(self, index: int, X_WB: RigidTransform) -> float | None:
        """Returns an object's heading, in radians; None if the object does not lie as it would in
        its cavity.

        The object must lie flat and the right way up. An object that has rolled is accepted, too,
        if its shape looks the same, for instance a round handle. Its heading is then that of the
        flat object that looks most similar.
        """
        yaw = heading(X_WB)
        if tilt(X_WB) < _FLAT:
            return yaw
        pitch = math.asin(float(np.clip(X_WB.rotation().matrix()[2, 0], -1, 1)))
        if tilt(X_WB) < _ROLLED or abs(pitch) > _ROLLED_PITCH:
            return None
        item = self.objects[index]
        points = item.p_BPoints @ X_WB.rotation().matrix().T
        yaws = yaw + np.linspace(-_ROLLED_PITCH, _ROLLED_PITCH, 21)
        deviations = [_deviation(item, points, float(angle)) for angle in yaws]
        best = int(np.argmin(deviations))
        # A deviation is measured between points, so even for equal surfaces it is about the spacing
        # of the points on one of them.
        spacing = float(item.tree.query(item.p_BPoints, k=2)[0][:, 1].mean())
        return float(yaws[best]) if deviations[best] < 1.1 * spacing + _SAME_SHAPE else None

    def holds(
        self,
        index: int,
        poses: Sequence[RigidTransform],
        points: Sequence[Points],
        failed: Sequence[PlanarPose] = (),
        *,
        ignores_fixtures: bool = False,
        steepest: float = _STEEPEST,
    ) -> list[HeldFromAbove]:
        """The grasps of an object, best first, without those that failed before or would slip.

        Args:
            index: index of the object.
            poses: X_WB of each object.
            points: the surface points of each object in the world.
            failed: gripper poses of earlier failed picks, in the world.
            ignores_fixtures: whether to ignore fixtures that are in the way. Set it for an object
                that lies in a cavity.
            steepest: the largest angle between a gripped face and the vertical, in radians.
        """
        around = [item for other, item in enumerate(points) if other != index]
        if not ignores_fixtures:
            around += list(self.fixtures)
        others = np.concatenate([np.zeros((0, 3)), *around])
        near = np.linalg.norm((others - poses[index].translation())[:, :2], axis=1) < 0.35
        found = []
        for grasp, gripper in self._grippers(index, poses[index], steepest):
            if gripper is None or any(_is_same(gripper, other) for other in failed):
                continue
            hold = self._hold(grasp, gripper, points[index], others[near])
            if hold is not None:
                found.append(hold)
        return found

    def _grippers(
        self, index: int, X_WB: RigidTransform, steepest: float
    ) -> list[tuple[Grasp, PlanarPose | None]]:
        """Each grasp with the gripper's pose in the world; the pose is None if the grasp would
        slip."""
        if not _ON_EDGE < tilt(X_WB) < _UPSIDE_DOWN:
            return [(grasp, _gripper_pose(X_WB, grasp, steepest)) for grasp in self.grasps[index]]
        # An object on its edge is gripped across its thickness: the jaws close along z of B.
        item = self.objects[index]
        z_axis = X_WB.rotation().matrix()[:, 2]
        theta = math.atan2(-z_axis[0], z_axis[1])
        height = float(np.ptp(item.p_BPoints[:, 2]))
        found: list[tuple[Grasp, PlanarPose | None]] = []
        for offset in _ALONG_EDGE:
            p_B = np.array([item.p_BCenter[0] + offset, item.p_BCenter[1], item.p_BMiddle[2]])
            x, y, _ = (X_WB @ p_B).tolist()
            grasp = Grasp(float(p_B[0]), float(p_B[1]), 0.0, height, height)
            found.append((grasp, PlanarPose(x, y, theta)))
        return found

    def _hold(
        self, grasp: Grasp, gripper: PlanarPose, own: Points, others: Points
    ) -> HeldFromAbove | None:
        along, across = _in_hand(own, gripper)
        between = (np.abs(along) < PAD_LENGTH / 2) & (np.abs(across) < grasp.width / 2 + 0.003)
        if not between.any():
            return None
        heights = own[between, 2]
        top, bottom = float(heights.max()), float(heights.min())
        below_palm = _highest_below_palm(others, gripper)
        surfaces = SurfaceHeights(pick_top=top, support=bottom, below_palm=below_palm)
        tip = motion_heights(surfaces, self.planner).grasp + _MARGIN
        half = self.planner.open_width / 2
        count = in_the_way(others, gripper, tip, (grasp.width / 2, half))
        lowest = float(own[:, 2].min())
        hold = HeldFromAbove(grasp, gripper, top, bottom, lowest, count, below_palm)
        if not count:
            return hold
        # Open the jaws only as far as the object needs, if fewer things are in the way then.
        beside = (np.abs(along) < FINGER_LENGTH / 2 + _MARGIN) & (own[:, 2] > tip)
        width = 2 * float(np.abs(across[beside]).max(initial=grasp.width / 2))
        halves = (grasp.width / 2, min(width / 2 + ROOM, half))
        fewer = in_the_way(others, gripper, tip, halves)
        return replace(hold, obstruction=fewer, width=width) if fewer < count else hold

    def aside(
        self,
        index: int,
        hold: HeldFromAbove,
        poses: Sequence[RigidTransform],
        points: Sequence[Points],
    ) -> PlanarPose | None:
        """The gripper pose at which an object is released to lay it aside; None if there is no
        room.

        The place is on a free part of the table. An object that lies upside down or stands on its
        edge is instead released over an edge of the ledge, with its centre of mass outside the
        edge, so that it turns over.
        """
        item, X_WB = self.objects[index], poses[index]
        others = [other for k, other in enumerate(points) if k != index]
        if self.ledge is not None and tilt(X_WB) > _ON_EDGE:
            yaw, p_WCenter = heading(X_WB), X_WB @ item.p_BCenter
            cos, sin = math.cos(yaw), math.sin(yaw)
            outline = (points[index] - p_WCenter)[:, :2] @ np.array([[cos, -sin], [sin, cos]])
            # An object on its edge falls onto the side that faces outward, so its underside must
            # face outward.
            on_edge = tilt(X_WB) < _UPSIDE_DOWN
            z_left = float(X_WB.rotation().matrix()[:2, 2] @ [-sin, cos])
            turned = self.ledge.turning_pose(
                outline,
                p_WCenter,
                np.concatenate([np.zeros((0, 3)), *others]),
                self.area,
                inner_side=(1 if z_left > 0 else -1) if on_edge else 0,
            )
            if turned is not None:
                return moved_gripper(hold.gripper, p_WCenter, yaw, turned)
        occupied = [other[:, :2] for other in (*others, *self.fixtures)]
        found = find_free_pose(
            (item.p_BPoints - item.p_BMiddle)[:: max(1, len(item.p_BPoints) // 400), :2],
            np.concatenate([np.zeros((0, 2)), *occupied]),
            self.area,
            near=X_WB.translation()[:2],
            yaw=heading(X_WB),
        )
        if found is None:
            return None
        return moved_gripper(
            hold.gripper, middle(points[index], heading(X_WB)), heading(X_WB), found
        )


def _deviation(item: PlacedObject, points: Points, yaw: float) -> float:
    """Mean distance, in metres, of points (m, 3) from an object's surface, after the points are
    rotated by -yaw and centred on the object."""
    turned = points @ RollPitchYaw(0, 0, -yaw).ToRotationMatrix().matrix().T
    own = item.p_BPoints
    shift = own.min(axis=0) + own.max(axis=0) - turned.min(axis=0) - turned.max(axis=0)
    return float(item.tree.query(turned + shift / 2)[0].mean())


def middle(points: Points, yaw: float) -> NDArray[np.float64]:
    """(2,) x and y of the middle of the box around points (m, 3), in metres. One side of the box
    has the direction `yaw`, in radians."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    along, across = points[:, :2] @ [cos, sin], points[:, :2] @ [-sin, cos]
    u, v = (along.min() + along.max()) / 2, (across.min() + across.max()) / 2
    return np.array([cos * u - sin * v, sin * u + cos * v])


def tilt(X_WB: RigidTransform) -> float:
    """The angle between body z and world z, in radians."""
    return math.acos(float(np.clip(X_WB.rotation().matrix()[2, 2], -1.0, 1.0)))


def in_the_way(points: Points, gripper: PlanarPose, tip: float, halves: tuple[float, float]) -> int:
    """Counts the points that the hand would hit as it comes down with open jaws and closes them.

    Args:
        points: (m, 3) in the world, in metres.
        gripper: the gripper's pose in the world.
        tip: world z of the fingertips, in metres.
        halves: half the opening of the jaws, in metres: when they hold the object, and when open.
    """
    along, across = _in_hand(points, gripper)
    along, across, z = np.abs(along), np.abs(across), points[:, 2]
    closed, opened = halves
    in_fingers = (along < FINGER_LENGTH / 2 + _MARGIN) & (across > closed) & (z > tip)
    reach = np.where(z > tip + _SLENDER, FINGER_DEPTH, FINGERTIP_DEPTH) + _MARGIN
    in_fingers &= across < opened + reach
    in_palm = (along < PALM_SIZE[0] / 2) & (across < PALM_SIZE[1] / 2) & (z > tip + _PALM_ROOM)
    return int((in_fingers | in_palm).sum())


def _highest_below_palm(points: Points, gripper: PlanarPose) -> float:
    """World z of the highest of points (m, 3) below the palm, in metres; minus infinity if there is
    none."""
    along, across = _in_hand(points, gripper)
    below = (np.abs(along) < PALM_SIZE[0] / 2) & (np.abs(across) < PALM_SIZE[1] / 2)
    return float(points[below, 2].max(initial=-math.inf))


def _in_hand(points: Points, gripper: PlanarPose) -> tuple[Points, Points]:
    """Coordinates of points in the gripper's frame, first along the pads and then across them, in
    metres."""
    cos, sin = math.cos(gripper.theta), math.sin(gripper.theta)
    dx, dy = points[:, 0] - gripper.x, points[:, 1] - gripper.y
    return cos * dx + sin * dy, cos * dy - sin * dx


def _gripper_pose(X_WB: RigidTransform, grasp: Grasp, steepest: float) -> PlanarPose | None:
    """The gripper's pose in the world; None if the angle between the gripped faces and the vertical
    exceeds `steepest`."""
    R = X_WB.rotation().matrix()
    across = R @ np.array([-math.sin(grasp.theta), math.cos(grasp.theta), 0.0])
    if abs(across[2]) > math.sin(steepest):
        return None
    x, y, _ = X_WB @ np.array([grasp.x, grasp.y, grasp.surface_height / 2])
    theta = math.atan2(-across[0], across[1])
    return PlanarPose(float(x), float(y), theta)


def _is_same(gripper: PlanarPose, other: PlanarPose) -> bool:
    turn = abs(math.remainder(gripper.theta - other.theta, math.pi))
    return math.hypot(gripper.x - other.x, gripper.y - other.y) < _SAME_PLACE and turn < _SAME_ANGLE


Squares = dict[tuple[int, int], tuple[float, float]]


def _squares(points: Points) -> Squares:
    """Returns the lowest and the highest z of the points (m, 3) in each square of the table that
    has points."""
    keys, where = np.unique(
        np.floor(points[:, :2] / _CELL).astype(int), axis=0, return_inverse=True
    )
    low, high = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
    np.minimum.at(low, where.reshape(-1), points[:, 2])
    np.maximum.at(high, where.reshape(-1), points[:, 2])
    return {tuple(key): (a, b) for key, a, b in zip(keys.tolist(), low, high, strict=True)}


def _is_on(above: Squares, below: Squares) -> bool:
    shared = above.keys() & below.keys()
    return sum(above[key][0] > below[key][1] - _ABOVE for key in shared) >= _LEAST_SQUARES
