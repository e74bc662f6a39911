"""Stores the planner's earlier actions, and the report of a policy that has stopped, in vectors of
discrete state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.signals import OUTCOMES, Attempt, LeftOver, PickPlaceAction, PlanarPose
from systems.vector_view import Array, Number, VectorView

MOST_ATTEMPTS = 64
"""Number of actions that are remembered."""
MOST_FAILED = 16
"""Number of failed picks that are remembered."""
_SAME_OBJECT = 0.040
"""A measured centre of mass closer than this to a pick, in metres, counts as that of the picked
object."""
MOST_LEFT_OVER = 24
"""A stored `LeftOver` has at most this many objects, and at most this many cavities."""


class _Row(VectorView):
    """The part of the vector that holds one attempt; all NaN if it is unused."""

    pick = Array(3)
    """Pick pose in the world: x and y in m, theta in rad."""
    place = Array(3)
    press = Number()
    aside = Number()
    middle = Array(2)
    """The middle of the picked object, x and y in the world in m; NaN if unknown."""
    spread = Array(3)
    """The variances xx, xy and yy of the picked object's points, in m^2; NaN if unknown."""
    outcome = Number()
    """Index of the outcome in `OUTCOMES`."""
    peak_force = Number()
    top = Number()
    """The expected height of the placed object's top, in m in the world; NaN unless the object was
    placed."""
    floor = Number()
    """The height of the surface at the place before the action, in m in the world; NaN for a press,
    and if the object was set down where it lay."""
    balance = Array(2)
    """Measured centre of mass of the object, x and y in the world in m; NaN unless the attempt set
    the object down again."""


class AttemptHistory:
    """Keeps the last `MOST_ATTEMPTS` actions in a vector that the caller owns."""

    size = MOST_ATTEMPTS * _Row.size
    """Number of elements of the vector."""

    def __init__(self, vector: NDArray[np.float64]) -> None:
        """
        Args:
            vector: (size,), at first all NaN; `append` and `amend` modify it.
        """
        self._rows = vector.reshape(-1, _Row.size)

    def append(
        self,
        action: PickPlaceAction,
        outcome: str,
        peak_force: float,
        balance: tuple[float, float] | None = None,
        top: float | None = None,
        floor: float | None = None,
    ) -> None:
        """Adds an attempt. If there is no room, the oldest one is dropped."""
        count = self._count()
        if count == MOST_ATTEMPTS:
            self._rows[:-1] = self._rows[1:].copy()
            count -= 1
        row = _Row(self._rows[count])
        row.pick, row.place = action.pick.as_array(), action.place.as_array()
        row.press, row.aside = action.press, action.aside
        row.middle = (np.nan, np.nan) if action.middle is None else action.middle
        row.spread = np.nan if action.spread is None else action.spread
        row.balance = (np.nan, np.nan) if balance is None else balance
        row.top = np.nan if top is None else top
        row.floor = np.nan if floor is None else floor
        self.amend(outcome, peak_force)

    def amend(self, outcome: str | None, peak_force: float) -> None:
        """Corrects the peak force of the latest attempt, and also its outcome if one is given."""
        row = _Row(self._rows[self._count() - 1])
        row.peak_force = peak_force
        if outcome is not None:
            row.outcome = OUTCOMES.index(outcome)

    def attempts(self) -> tuple[Attempt, ...]:
        """The attempts, oldest first."""
        found = []
        for values in self._rows[: self._count()]:
            row = _Row(values)
            pick, place = (PlanarPose(*pose.tolist()) for pose in (row.pick, row.place))
            action = PickPlaceAction(
                pick,
                place,
                press=bool(row.press),
                aside=bool(row.aside),
                middle=known_point(row.middle),
                spread=known_spread(row.spread),
            )
            balance = known_point(row.balance)
            top, floor = (None if np.isnan(z) else z for z in (row.top, row.floor))
            outcome = OUTCOMES[int(row.outcome)]
            found.append(Attempt(action, outcome, row.peak_force, balance, top, floor))
        return tuple(found)

    def failed_picks(self) -> tuple[PlanarPose, ...]:
        """The last `MOST_FAILED` picks whose actions did not place their object, oldest first."""
        failed = [item.action.pick for item in self.attempts() if item.outcome != "placed"]
        return tuple(failed[-MOST_FAILED:])

    def set_downs(self, pick: PlanarPose) -> int:
        """How many attempts lifted the object at a pick and set it down again.

        Such an attempt measures the object's centre of mass first. It is counted if this centre is
        within `_SAME_OBJECT` of the pick.
        """
        felt = self._rows[: self._count(), -2:]
        away = np.linalg.norm(felt - (pick.x, pick.y), axis=1)
        return int(np.count_nonzero(away < _SAME_OBJECT))

    def _count(self) -> int:
        return int(np.count_nonzero(~np.isnan(self._rows[:, 0])))


def known_point(point: NDArray[np.float64]) -> tuple[float, float] | None:
    """Returns a stored point (2); None if it is NaN."""
    x, y = point.tolist()
    return None if np.isnan(x) else (x, y)


def known_spread(spread: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """Returns the stored variances (3) of an object's points; None if they are NaN, or zero as
    before the first action."""
    xx, xy, yy = spread.tolist()
    return (xx, xy, yy) if xx > 0 else None


class LeftOverVector:
    """Stores a `LeftOver`, or None, in a vector that the caller owns."""

    size = 1 + 4 * MOST_LEFT_OVER
    """Number of elements of the vector. The first is 1 if there is a `LeftOver`, else 0. Then
    follow x and y of each object and of each cavity; unused elements are NaN."""

    def __init__(self, vector: NDArray[np.float64]) -> None:
        """
        Args:
            vector: (size,), at first all zero; `write` modifies it.
        """
        self._vector = vector

    def write(self, left_over: LeftOver | None) -> None:
        """Stores a `LeftOver`, but at most `MOST_LEFT_OVER` of its objects and of its cavities."""
        self._vector[:] = np.nan
        self._vector[0] = left_over is not None
        if left_over is None:
            return
        for kept, points in zip(
            self._points(), (left_over.objects, left_over.cavities), strict=True
        ):
            given = np.array(points[:MOST_LEFT_OVER], float).reshape(-1, 2)
            kept[: len(given)] = given

    def read(self) -> LeftOver | None:
        """The `LeftOver` that was written last; None if there is none."""
        if not self._vector[0]:
            return None
        objects, cavities = (
            tuple((x, y) for x, y in kept[~np.isnan(kept[:, 0])].tolist())
            for kept in self._points()
        )
        return LeftOver(objects, cavities)

    def _points(self) -> NDArray[np.float64]:
        return self._vector[1:].reshape(2, MOST_LEFT_OVER, 2)
