"""Tells which objects rest out of reach of everything that moves, so that they can sleep."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem


@dataclass(frozen=True)
class BoundedBody:
    """A body and a box around its collision geometry."""

    body: BodyIndex
    p_BLower: NDArray[np.float64]
    """(3,) lower corner of the box, in the body frame, in metres."""
    p_BUpper: NDArray[np.float64]
    """(3,) upper corner."""


class RestDetector(LeafSystem):
    """Says which objects may be frozen without changing what happens.

    .. pydrake_system::

        name: RestDetector
        input_ports:
        - body_poses
        output_ports:
        - at_rest

    - `body_poses`: the plant's port of this name.
    - `at_rest` (n): 1 for an object that is at rest, else 0, in the order of `objects`.

    An object comes to rest when for `time_to_sleep` it has stayed within both tolerances of one
    pose, and nothing that is not at rest, mover or object, is within `wake_distance` of it:
    distances of oriented bounding boxes, never more than the true ones. It is no longer at rest as
    soon as something comes that near. Displacements are compared, not velocities: an object that
    trembles in place, as on a step too long for its stiffness, goes nowhere. The memory (discrete
    state) is the pose that each object has stayed near, since when, in s, and whether it is at
    rest.
    """

    def __init__(
        self,
        *,
        objects: Sequence[BoundedBody],
        movers: Sequence[BoundedBody],
        position_tolerance: float,
        angle_tolerance: float,
        time_to_sleep: float,
        wake_distance: float,
        period: float = 1 / 64,
    ) -> None:
        """
        Args:
            objects: what may come to rest; n of them.
            movers: what never does: the links of the hand.
            position_tolerance: of the body origin, in m.
            angle_tolerance: in rad.
            time_to_sleep: in s.
            wake_distance: in m. What moves faster than this in a period may touch an object before
                it wakes: for that long the object stands as firm as a rock.
            period: how often to look, in s.
        """
        super().__init__()
        self._count = len(objects)
        bodies = [*objects, *movers]
        self._bodies = [int(item.body) for item in bodies]
        self._centres = np.array([(item.p_BLower + item.p_BUpper) / 2 for item in bodies])
        self._half_sizes = np.array([(item.p_BUpper - item.p_BLower) / 2 for item in bodies])
        self._position_tolerance = position_tolerance
        # A rotation by an angle a differs from none by 2 sqrt(2) sin(a / 2) in Frobenius norm.
        self._rotation_tolerance = 2 * np.sqrt(2) * np.sin(angle_tolerance / 2)
        self._time_to_sleep = time_to_sleep
        self._wake_distance = wake_distance
        self._period = period
        self._poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        # Nothing is near infinity: the first look finds every object elsewhere.
        self._anchors = self.DeclareDiscreteState(np.full(12 * self._count, np.inf))
        self._still_for = self.DeclareDiscreteState(self._count)
        self._at_rest = self.DeclareDiscreteState(self._count)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareStateOutputPort("at_rest", self._at_rest)

    def at_rest(self, context: Context) -> NDArray[np.bool_]:
        """(n,) which objects are at rest in the given context (its own)."""
        return context.get_discrete_state(self._at_rest).value() > 0.5

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        n = self._count
        poses = self._poses.Eval(context)
        X = np.array([poses[body].GetAsMatrix34() for body in self._bodies])
        anchors = discrete_state.get_mutable_value(self._anchors).reshape(n, 3, 4)
        still_for = discrete_state.get_mutable_value(self._still_for)
        moved = X[:n] - anchors
        stayed = (np.linalg.norm(moved[:, :, 3], axis=1) <= self._position_tolerance) & (
            np.linalg.norm(moved[:, :, :3], axis=(1, 2)) <= self._rotation_tolerance
        )
        anchors[~stayed] = X[:n][~stayed]
        still_for[:] = np.where(stayed, still_for + self._period, 0.0)
        resting = still_for >= self._time_to_sleep - self._period / 2
        near = self._near(X)
        # An awake object wakes its neighbours, and they theirs.
        for _ in range(n):
            awake = np.concatenate([~resting, np.ones(len(self._bodies) - n, bool)])
            woken = resting & (near & awake).any(axis=1)
            if not woken.any():
                break
            resting &= ~woken
        discrete_state.get_mutable_value(self._at_rest)[:] = resting
        return EventStatus.Succeeded()

    def _near(self, X: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n, bodies) which bodies' boxes are within the wake distance of each object's.

        Args:
            X: (bodies, 3, 4) X_WB of each.
        """
        rotations, origins = X[:, :, :3], X[:, :, 3]
        centres = origins + np.einsum("bij,bj->bi", rotations, self._centres)
        halves = self._half_sizes
        # (i, j) pairs of objects and bodies; the widest gap along the six face normals of a pair is
        # a lower bound of the distance of their boxes.
        n, bodies = self._count, len(self._bodies)
        shape = (n, bodies, 3, 3)
        axes = np.concatenate(
            [
                np.broadcast_to(rotations[:n, None], shape),
                np.broadcast_to(rotations[None], shape),
            ],
            axis=3,
        )
        offsets = np.abs(np.einsum("ijka,ijk->ija", axes, centres[:n, None] - centres[None]))
        reach_i = np.einsum(
            "ijab,ib->ija", np.abs(np.einsum("ijka,ikb->ijab", axes, rotations[:n])), halves[:n]
        )
        reach_j = np.einsum(
            "ijab,jb->ija", np.abs(np.einsum("ijka,jkb->ijab", axes, rotations)), halves
        )
        near = (offsets - reach_i - reach_j).max(axis=2) < self._wake_distance
        near[np.arange(n), np.arange(n)] = False
        return near
