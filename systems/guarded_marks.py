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
        The first height is above all surfaces near the goal, by a margin. Below the second height,
        contact is expected. Both may be below the goal.
    """
    margin = parameters.slow_margin + state.doubt
    hover = state.pick_hover_z if mode == Mode.DESCEND else state.place_hover_z
    first = hover - parameters.hover_clearance + margin
    if mode == Mode.DESCEND:
        # Contact is expected only if the hand presses: the closed jaws may touch the object, or a
        # higher surface beside it. On the way to a grasp the jaws should touch nothing.
        return first, first if state.press else state.grasp_z
    # First either the object touches the floor of its place, or the fingertips touch the rim beside
    # the place. Use the higher contact.
    hanging = state.hold_z - state.support_z + state.hanging
    return first, max(state.floor_z + hanging, state.rim_z + state.doubt) + margin
