"""Where guarded motions slow down."""

from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import PlannerState


def guarded_marks(
    state: PlannerState, mode: Mode, parameters: PickPlaceParameters
) -> tuple[float, float]:
    """Heights of the fingertips in a guarded motion, in m.

    Args:
        state: the planner's state.
        mode: `DESCEND` or `LOWER`.
        parameters: clearances and margins.

    Returns:
        The height down to which the hand is above all surfaces near its goal, and that from which
        on contact is expected. They may be below the goal.
    """
    margin = parameters.slow_margin + state.doubt
    hover = state.pick_hover_z if mode == Mode.DESCEND else state.place_hover_z
    first = hover - parameters.hover_clearance + margin
    if mode == Mode.DESCEND:
        # The jaws should touch nothing, except to press.
        return first, state.pick_top_z + margin if state.press else state.grasp_z
    # Either the object reaches its floor, or the fingertips beside it the rim.
    hanging = state.hold_z - state.support_z
    return first, max(state.floor_z + hanging, state.rim_z + state.doubt) + margin
