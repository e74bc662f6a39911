"""Finds how far a held object hangs below the height at which it was gripped.

An object that turns between the pads leaves the table late, end last, and so does a second object
that is caught in it. Until then the table bears a share of the weight, so the weight that the hand
feels still changes.
"""

from systems.planner_state import PlannerState

_TOLERANCE, _LEAST_TOLERANCE = 0.12, 0.2
"""The felt weight counts as changed if two samples in a row differ from its earlier value by more
than this fraction of it, and by more than `_LEAST_TOLERANCE`, in N. A single sample is wrong when
the hand begins to brake."""
_RAISED = 0.008
"""Below this height above the grip, in m, the weight also changes because the pads yield and the
hand accelerates."""
_MORE = 1.5
"""An object that has turned between the pads turns further on the way. It is taken to hang lower by
this factor."""
_MOST = 0.12
"""Largest distance by which the planner takes an object to hang lower, in m."""
_NOTABLE = 0.003
"""A smaller increase of the distance, in m, does not change the motion."""


def begin_lift(state: PlannerState, height: float) -> None:
    """Forgets the previous object.

    Args:
        state: the planner's state; modified.
        height: the height of the fingertips at the grip, in m.
    """
    state.steady_weight = state.latest_weight = state.hanging = 0.0
    state.steady_z = height


def feel_weight(state: PlannerState, weight: float, height: float) -> None:
    """Notes the height if the felt weight has changed. Call it at every step in which
    the hand lifts the object.

    Args:
        state: the planner's state; modified.
        weight: the result of `felt_weight`, in N.
        height: the height of the fingertips, in m.
    """
    known, latest = float(state.steady_weight), float(state.latest_weight)
    state.latest_weight = weight
    if min(abs(weight - known), abs(latest - known)) > max(
        _TOLERANCE * abs(known), _LEAST_TOLERANCE
    ):
        state.steady_weight, state.steady_z = weight, height


def lift_higher(state: PlannerState) -> bool:
    """Raises the heights of the way if the object hangs lower than they assume.

    Args:
        state: the planner's state, at the end of `LIFT` or while the hand still rises in `CARRY`;
            modified.

    Returns:
        Whether the lift must go on.
    """
    late = state.steady_z - state.hold_z
    hangs = min(_MORE * late, _MOST) if late > _RAISED else 0.0
    more = hangs - state.hanging
    if more < _NOTABLE:
        return False
    state.hanging = hangs
    state.travel_z += more
    state.place_hover_z += more
    return True
