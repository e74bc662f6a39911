"""Detects objects at rest with nothing moving near them, so that they can be frozen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from systems.placement import GONE


@dataclass(frozen=True)
class Box:
    """An oriented box around a piece of a body's collision geometry."""

    X_BBox: RigidTransform
    half_size: NDArray[np.float64]
    """(3,) half of the side lengths, in metres."""


@dataclass(frozen=True)
class BoundedBody:
    """A body and the boxes around its collision geometry."""

    body: BodyIndex
    boxes: Sequence[Box]


_NOWHERE = 1e6
"""Every element of a pose's matrix before the first update; far from every pose."""
_RESTS_EVERY = 1 / 16
"""Objects come to rest only at multiples of this time, in s. Objects that touch must come to rest
together, because each would wake the other."""
_ROTATION_AND_POSITION = np.tile([[1, 0], [1, 0], [1, 0], [0, 1]], (3, 1)).astype(float)
"""(12, 2): sums the elements of the rotation, and those of the position, of a pose's (3, 4)
matrix."""


class _Boxes:
    """The half sizes and poses of k boxes, as arrays."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        poses = np.array([box.X_BBox.GetAsMatrix34() for box in boxes])
        self.rotations, self.centres = poses[:, :, :3], poses[:, :, 3]
        self.halves = np.array([box.half_size for box in boxes], float)

    def posed(self, X: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Rotations (k, 3, 3), centres (k, 3) and half sizes (k, 3) of the posed boxes.

        Args:
            X: (3, 4) pose of the boxes' common frame.
        """
        return X[:, :3] @ self.rotations, self.centres @ X[:, :3].T + X[:, 3], self.halves

    def enclosing(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre (3) and half size (3) of the box around all boxes, aligned with their common
        frame."""
        reach = np.einsum("kij,kj->ki", np.abs(self.rotations), self.halves)
        lower = (self.centres - reach).min(axis=0)
        upper = (self.centres + reach).max(axis=0)
        return (lower + upper) / 2, (upper - lower) / 2


def _gaps(
    first: Sequence[NDArray[np.float64]], second: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """(m, n) lower bounds of the distances between m boxes and n other boxes, in metres.

    The bound is the widest gap along the six face normals of the two boxes.
    """
    # Use matrix products where possible: `einsum` takes up to twice as long.
    (R_i, centres_i, halves_i), (R_j, centres_j, halves_j) = first, second
    m, n = len(R_i), len(R_j)
    normals_i, normals_j = R_i.transpose(0, 2, 1), R_j.transpose(0, 2, 1)
    relative = np.abs(normals_i.reshape(-1, 3) @ normals_j.reshape(-1, 3).T).reshape(m, 3, n, 3)
    apart = centres_i[:, None] - centres_j
    along_i = np.abs(normals_i @ apart.transpose(0, 2, 1)) - halves_i[:, :, None]
    along_i -= np.einsum("aibj,bj->aib", relative, halves_j)
    along_j = np.abs(normals_j @ apart.transpose(1, 2, 0)) - halves_j[:, :, None]
    along_j -= np.einsum("aibj,ai->bja", relative, halves_i)
    return np.maximum(along_i.max(axis=1), along_j.max(axis=1).T)


class RestDetector(LeafSystem):
    """Detects which objects may be frozen without changing the simulation's outcome.

    .. pydrake_system::

        name: RestDetector
        input_ports:
        - body_poses
        output_ports:
        - at_rest

    - `body_poses`: the plant's port of this name.
    - `at_rest` (n): 1 for an object that is at rest, else 0, in the order of `objects`.

    An object comes to rest if two conditions hold:

    - For `time_to_sleep` it has stayed within both tolerances of one pose. Displacements are
      compared, not velocities, because an object may tremble in place if the time step is too long
      for the stiffness of its contacts.
    - No mover, and no object that is not at rest, is within `wake_distance` of it. The distances
      are those of the oriented boxes around the collision geometry, which are lower bounds.

    An object at rest wakes when a mover, or an object that is not at rest, comes within
    `wake_distance`. Objects come to rest only at multiples of 1/16 s. An object that has left the
    cell (its distance from the world's origin is `GONE` or more) is at rest at once, because a body
    that spins forever would overflow its quaternion.

    State (discrete): for each object the pose that it stays near, the time that it has stayed
    there (s), and whether it rests; the poses when distances were last tested, and how far bodies
    may move before the next test.
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
            objects: n bodies that may come to rest.
            movers: bodies that never rest: the links of the hand.
            position_tolerance: an object whose origin moves farther than this, in m, has not stayed
                in place.
            angle_tolerance: an object that rotates farther than this, in rad, has not stayed in
                place.
            time_to_sleep: how long an object must stay in place, in s.
            wake_distance: distance at which something wakes an object, in m. A body that moves
                farther than this within one period may hit an object at rest, which stays fixed
                until the next update.
            period: the period of the updates, in s.
        """
        super().__init__()
        self._count = len(objects)
        bodies = [*objects, *movers]
        self._bodies = [int(item.body) for item in bodies]
        self._pieces = [_Boxes(item.boxes) for item in bodies]
        wholes = [pieces.enclosing() for pieces in self._pieces]
        # Centres and half sizes, (bodies, 3) each, of a box around each body, in the body's frame.
        self._centres = np.array([centre for centre, _ in wholes])
        self._halves = np.array([half_size for _, half_size in wholes])
        # A point at the distance r from its body's origin moves by at most r times the Frobenius
        # norm of the change of rotation, plus the displacement of the origin.
        radii = np.linalg.norm(np.abs(self._centres) + self._halves, axis=1)
        self._reaches = np.column_stack([radii, np.ones(len(radii))])
        # A rotation by the angle a differs from the identity by 2 sqrt(2) sin(a / 2) in the
        # Frobenius norm.
        self._tolerances = np.square(
            [2 * np.sqrt(2) * np.sin(angle_tolerance / 2), position_tolerance]
        )
        self._time_to_sleep = time_to_sleep
        self._wake_distance = wake_distance
        self._period = period
        self._rests_every = max(1, round(_RESTS_EVERY / period))
        self._poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        # The poses that the objects must stay near, then the poses of all bodies at the last test.
        self._references = self.DeclareDiscreteState(
            np.full(12 * (self._count + len(bodies)), _NOWHERE)
        )
        self._still_for = self.DeclareDiscreteState(self._count)
        self._at_rest = self.DeclareDiscreteState(self._count)
        self._margin = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareStateOutputPort("at_rest", self._at_rest)

    def at_rest(self, context: Context) -> NDArray[np.bool_]:
        """(n,) whether each object is at rest, in this system's context."""
        return context.get_discrete_state(self._at_rest).value() > 0.5

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        n = self._count
        poses = self._poses.Eval(context)
        now = np.array([poses[body].GetAsMatrix34() for body in self._bodies]).reshape(-1, 12)
        references = discrete_state.get_mutable_value(self._references).reshape(-1, 12)
        still_for = discrete_state.get_mutable_value(self._still_for)
        at_rest = discrete_state.get_mutable_value(self._at_rest)
        changes = np.concatenate([now[:n], now]) - references
        squares = changes * changes @ _ROTATION_AND_POSITION
        stayed = (squares[:n] <= self._tolerances).all(axis=1)
        still_for += self._period
        if not stayed.all():
            references[:n][~stayed] = now[:n][~stayed]
            still_for[~stayed] = 0.0
        resting = stayed & (still_for >= self._time_to_sleep - self._period / 2)
        if round(context.get_time() / self._period) % self._rests_every:
            # Nothing comes to rest now.
            resting &= at_rest > 0.5
        if resting.any():
            margin = discrete_state.get_mutable_value(self._margin)
            moved = 2 * (np.sqrt(squares[n:]) * self._reaches).sum(axis=1).max()
            # The first condition is also true for NaN.
            if not moved <= margin[0] or (resting != at_rest).any():
                margin[0] = self._wake(now.reshape(-1, 3, 4), resting)
                references[n:] = now
        at_rest[:] = resting
        # This form is also true for NaN.
        if not np.abs(now[:n]).max(initial=0.0) < GONE / 2:
            at_rest[~(np.linalg.norm(now[:n, 3::4], axis=1) < GONE)] = 1.0
        return EventStatus.Succeeded()

    def _wake(self, X: NDArray[np.float64], resting: NDArray[np.bool_]) -> float:
        """Sets `resting` to false for objects near a body that is not at rest.

        Args:
            X: (bodies, 3, 4) X_WB of each body.
            resting: (n,) whether each object rests; modified.

        Returns:
            How far two bodies may approach each other, in m, before another object can wake; 0 if
            an object has woken.
        """
        n = self._count
        waking = np.ones(len(self._bodies), bool)
        waking[:n] = ~resting
        # Cheap tests come first: boxes aligned with the world, then boxes around bodies, then boxes
        # around their pieces. Most of the time the first suffices.
        rotations = X[:, :, :3]
        centres = (rotations @ self._centres[:, :, None])[:, :, 0] + X[:, :, 3]
        reach = (np.abs(rotations) @ self._halves[:, :, None])[:, :, 0]
        apart = np.abs(centres[:n, None] - centres) - reach[:n, None] - reach
        margins = apart.max(axis=2) - self._wake_distance
        boxes = rotations, centres, self._halves
        wakes = False
        # An awake object wakes its neighbours, which wake theirs.
        while True:
            i, j = np.flatnonzero(resting), np.flatnonzero(waking)
            near = margins[np.ix_(i, j)]
            if (near < 0).any():
                gaps = _gaps(*([part[k] for part in boxes] for k in (i, j)))
                near = np.maximum(near, gaps - self._wake_distance)
            waking[:] = False
            for a, b in np.argwhere(near < 0):
                if resting[i[a]]:
                    near[a, b] = self._gap(X, i[a], j[b]) - self._wake_distance
                    if near[a, b] < 0:
                        resting[i[a]], waking[i[a]] = False, True
            if not waking.any():
                return 0.0 if wakes else float(near.min(initial=np.inf))
            wakes = True

    def _gap(self, X: NDArray[np.float64], i: int, j: int) -> float:
        """A lower bound of the distance between the pieces of two bodies, in m."""
        return float(_gaps(self._pieces[i].posed(X[i]), self._pieces[j].posed(X[j])).min())
