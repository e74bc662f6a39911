"""Modes of the pick-and-place motion primitive, and its heights, speeds and thresholds."""

import enum
from dataclasses import dataclass, field, replace

from systems.bounds import bounded
from systems.hand_motion import MotionLimits
from systems.insertion_search import InsertionSearch


class Mode(enum.IntEnum):
    """The planner's modes. A successful pick and place passes through them in order, up to DONE."""

    OBSERVE = 0
    """Wait where the hand does not hide the table from the cameras, then query the policy."""
    APPROACH = 1
    """Move above the pick and open the jaws."""
    DESCEND = 2
    """Descend to the grasp height, or until contact."""
    CLOSE = 3
    """Close the jaws until they stall, then squeeze."""
    CHECK = 4
    """Check whether an object is between the pads."""
    LIFT = 5
    """Rise until the object clears everything."""
    CARRY = 6
    """Move above the place and rotate."""
    LOWER = 7
    """Descend until contact."""
    RELEASE = 8
    RETREAT = 9
    """Rise and move out of the cameras' sight."""
    DONE = 10
    SEARCH = 11
    """Search for the cavity after a blocked insertion; see `InsertionSearch`."""


_BRAKING = 4.0
"""The force of a press rises by up to this, in N, while the hand brakes."""


@dataclass
class PickPlaceParameters:
    """Heights, speeds and thresholds of the motion primitive."""

    # The hand's home: x, y, height of the fingertips (m), yaw (rad). The hand starts there; after
    # each action it returns to this x and height and keeps its y and yaw. The home must be out of
    # the cameras' sight. The default suits the three default cameras. For an overhead camera
    # choose for example [-0.4, 0, 0.4, 0].
    home: list[float] = bounded([0.5, 0.0, 0.4, 0.0], -2.0, 2.0)

    # Clearance of the fingertips or the held object above the highest surface of the heightmap o_t
    # while the hand crosses the table, in m.
    travel_clearance: float = bounded(0.015, 0.0, 0.1)

    # The hand moves fast until it is this far above the surfaces around its goal in o_t, in m.
    hover_clearance: float = bounded(0.010, 0.001, 0.1)

    # The fingertips go below the object's top by `grasp_depth_share` of its height, but by at least
    # `grasp_depth` and at most `max_grasp_depth`, in m. On a round handle the pads should be near
    # the widest section. Where the palm has too little room the hand grips higher.
    grasp_depth: float = bounded(0.010, 0.001, 0.05)
    max_grasp_depth: float = bounded(0.018, 0.001, 0.05)
    grasp_depth_share: float = bounded(0.4, 0.0, 1.0)

    # Least height of the fingertips above the table, in m; less for objects lower than 10 mm.
    floor_clearance: float = bounded(0.0015, 0.0, 0.05)

    # Opening of the jaws before a grasp, in m.
    open_width: float = bounded(0.080, 0.005, 0.080)

    # How far each jaw opens to release an object, in m.
    release_clearance: float = bounded(0.006, 0.001, 0.04)

    # Force of each pad on the held object, in N.
    grasp_force: float = bounded(30.0, 1.0, 140.0)

    # The grip is firmer for heavier objects, because an object that is gripped away from its centre
    # of mass may turn between the pads. The force is `firm_grasp_force` for a weight of
    # `heavy_load` and `peak_grasp_force` for `heaviest_load`, all in N (see `grip_force`). A Franka
    # Hand grips with 70 N continuously and with up to 140 N for a short time.
    firm_grasp_force: float = bounded(70.0, 1.0, 140.0)
    heavy_load: float = bounded(5.0, 0.5, 100.0)
    peak_grasp_force: float = bounded(140.0, 1.0, 140.0)
    heaviest_load: float = bounded(20.0, 0.5, 100.0)

    # A grasp counts as empty if the squeezing pads are closer to each other than this, in m.
    minimum_width: float = bounded(0.0005, 0.0, 0.08)

    # If an object sticks out of its cavity, closed jaws press on its top with up to `press_force`,
    # in N, and go down from there by at most `press_depth`, in m. They touch the object at
    # `touch_speed`.
    press_force: float = bounded(30.0, 1.0, 140.0)
    press_depth: float = bounded(0.020, 0.001, 0.05)

    # A vertical contact force that exceeds the payload's weight by more than this, in N, is a
    # contact.
    contact_threshold: float = bounded(4.0, 0.5, 100.0)

    # A contact force on the hand beyond this, in N, ends the action: the hand stops, lets go and
    # rises. `ContactGuard` compares the vertical force, without the payload's weight, and the
    # lateral force.
    force_limit: float = bounded(30.0, 5.0, 140.0)

    # Highest linear speed (m/s) and acceleration (m/s^2) in free space, separately for the
    # horizontal and the vertical motion. An arm may be slower, because of the limits of its joints.
    linear_speed: float = bounded(1.2, 0.01, 1.2)
    linear_acceleration: float = bounded(8.0, 0.1, 9.0)

    # Highest linear speed (m/s) and acceleration (m/s^2) with an object in the hand.
    carry_speed: float = bounded(1.2, 0.01, 1.2)
    carry_acceleration: float = bounded(5.0, 0.1, 9.0)

    # Highest yaw speed (rad/s) and acceleration (rad/s^2).
    yaw_speed: float = bounded(2.5, 0.01, 2.5)
    yaw_acceleration: float = bounded(20.0, 0.1, 25.0)

    # Highest speeds in DESCEND and LOWER, in m/s. `descend_speed` and `lower_speed` apply while the
    # hand is higher than all surfaces near its goal. Lower down, where a contact is possible,
    # `contact_speed` applies, and where a contact is expected, `touch_speed`. The force
    # of an impact is proportional to the speed: about 10 N at 0.015 m/s.
    descend_speed: float = bounded(0.20, 0.005, 1.0)
    lower_speed: float = bounded(0.20, 0.005, 1.0)
    contact_speed: float = bounded(0.05, 0.005, 1.0)
    touch_speed: float = bounded(0.015, 0.002, 1.0)

    # The hand slows down this far, in m, above the first possible contact and again above the
    # expected contact. The uncertainty of the heights is added.
    slow_margin: float = bounded(0.001, 0.0, 0.02)

    # Parameters of the search after a blocked insertion. Used only in tasks that insert objects
    # into cavities.
    search: InsertionSearch = field(default_factory=InsertionSearch)

    # Speed of one finger, in m/s.
    finger_speed: float = bounded(0.05, 0.005, 0.05)

    # Time in which the grasp force builds up and decays, in s. Keep it short: a heavy object that
    # is released slowly swings about the pads.
    force_ramp: float = bounded(0.03, 0.0, 5.0)

    # How long the hand rests before the cameras look (`observe_settle`), and at most before it
    # checks its grip or tares the payload (`tare_settle`), in s.
    observe_settle: float = bounded(0.10, 0.0, 10.0)
    tare_settle: float = bounded(0.10, 0.0, 10.0)

    # The planner stops after this many actions; null stands for the task's own limit.
    max_actions: int | None = bounded(None, 0, 1000)

    @property
    def press_stop_force(self) -> float:
        """The force at which the hand stops a press, in N. It is below `press_force`, because the
        force still rises while the hand brakes."""
        return max(self.press_force - _BRAKING, 0.5 * self.press_force)

    def motion_limits(self) -> dict[Mode, MotionLimits]:
        """The limits of each mode's motion."""
        yaw = (self.yaw_speed, self.yaw_acceleration)
        free = MotionLimits(self.linear_speed, self.linear_acceleration, *yaw)
        limits = dict.fromkeys(Mode, free)
        carry = MotionLimits(self.carry_speed, self.carry_acceleration, *yaw)
        limits[Mode.LIFT] = limits[Mode.CARRY] = carry
        limits[Mode.DESCEND] = replace(free, speed=self.descend_speed)
        limits[Mode.LOWER] = replace(carry, speed=self.lower_speed)
        limits[Mode.SEARCH] = replace(
            limits[Mode.LOWER],
            speed=min(self.search.speed, self.contact_speed),
            yaw_speed=min(self.search.yaw_speed, self.yaw_speed),
        )
        return limits
