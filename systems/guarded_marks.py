"""Computes the heights at which the hand slows down while it descends."""

from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import PlannerState


def guarded_marks(
    state: PlannerState, mode: Mode, parameters: PickPlaceParameters
) -> tuple[float, float]:
    """Two heights of the fingertips at which a descending hand slows down, in m.

    Args:
        state: the planner's state.
        mode: `DESCEND` or `LOWER`.
        parameters: clearances and margins.

    Returns:
        The first height is a margin above all surfaces near the goal. From the second one downwards
        contact is expected. Both may be below the goal.
    """
    margin = parameters.slow_margin + state.doubt
    hover = state.pick_hover_z if mode == Mode.DESCEND else state.place_hover_z
    first = hover - parameters.hover_clearance + margin
    if mode == Mode.DESCEND:
        # Contact is expected only if the hand presses; on the way to a grasp the jaws should touch
        # nothing.
        return first, state.pick_top_z + margin if state.press else state.grasp_z
    # The first contact is either that of the object with the floor of its place, or that of the
    # fingertips with the rim beside it. Use the higher one.
    hanging = state.hold_z - state.support_z
    return first, max(state.floor_z + hanging, state.rim_z + state.doubt) + margin
