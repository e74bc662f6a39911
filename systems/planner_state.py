"""The state of the pick-and-place motion primitive."""

from systems.motion_heights import MotionHeights
from systems.signals import SurfaceHeights
from systems.vector_view import Array, Number, VectorView

X, Y, Z, YAW = range(4)
"""Indices of the hand's axes in `PlannerState.start` and `goal`."""


RECENT = 16
"""How many contact forces the state keeps."""


class PlannerState(VectorView):
    """The planner's state vector, in SI units."""

    mode = Number()
    start_time = Number()
    duration = Number()
    start = Array(4)
    """x, y, z and yaw at the start of the present motion."""
    goal = Array(4)
    """x, y, z and yaw at its end."""
    start_rate = Array(4)
    """The velocities at its start."""
    delays = Array(3)
    """When each of the motion's `PARTS` begins, after `start_time`."""
    leg_ways = Array(3)
    """The ways of a guarded motion along z, in order; zero if there is none."""
    leg_delays = Array(3)
    start_opening = Number()
    goal_opening = Number()
    start_force = Number()
    goal_force = Number()
    force_start_time = Number()
    pick = Array(3)
    """x, y and yaw of the hand at the pick. Likewise `place`."""
    place = Array(3)
    grasp_z = Number()
    travel_z = Number()
    clear_z = Number()
    pick_top_z = Number()
    pick_hover_z = Number()
    place_hover_z = Number()
    table_z = Number()
    support_z = Number()
    rim_z = Number()
    floor_z = Number()
    doubt = Number()
    """The uncertainty of these heights."""
    width = Number()
    """The width of the object at the pick; infinite if unknown."""
    hold_z = Number()
    """Height of the hand when it gripped; `touch_z`: when the object touched a cavity's rim."""
    touch_z = Number()
    search_step = Number()
    payload = Number()
    """The vertical force of the payload, in N."""
    weighings = Number()
    """How many samples the payload is the mean of."""
    beyond = Number()
    """For how long the contact force has been beyond the limit, in s."""
    recent = Array(3 * RECENT)
    """x, y and z of the last contact forces, latest first, without weight and inertia of the held
    object, in N."""
    peak_vertical = Number()
    """The largest contact forces of the action, in N."""
    peak_lateral = Number()
    peak_mode = Number()
    """The mode in which the larger one rose."""
    actions = Number()
    missed = Number()
    dropped = Number()
    stopped = Number()
    stops = Number()
    """1 if the force guard has ended the action, else 0."""
    refused = Number()
    """1 if the action cannot be reached, else 0."""
    press = Number()
    """1 if the action presses, else 0."""
    aside = Number()
    """1 if the action lays the object aside, else 0."""
    lever = Number()
    """How far the centre of mass of an object that is set down lies from the pads' middle along
    them, in m."""
    doubts_grip = Number()
    """1 if the object seems to turn between the pads, and is set down again if it does, else 0."""
    set_downs = Number()
    """How many earlier actions have set this object down."""
    free_actions = Number()
    """How many actions do not count against the limit, because they set the object down."""
    stop = Number()
    """0 while there are actions; then 1 plus the index of the reason in `STOP_REASONS`."""

    def set_heights(self, motion: MotionHeights, surfaces: SurfaceHeights) -> None:
        """Writes the heights of an action."""
        self.grasp_z, self.pick_top_z = motion.grasp, surfaces.pick_top
        self.table_z, self.support_z = surfaces.table, surfaces.support
        # An object slightly below an uncertain rim may stand on it.
        self.rim_z = surfaces.place_rim - surfaces.doubt
        self.floor_z, self.doubt = surfaces.place_floor, surfaces.doubt
        self.width = surfaces.width
        self.clear_z, self.travel_z = motion.clear, motion.travel
        self.pick_hover_z, self.place_hover_z = motion.pick_hover, motion.place_hover
