"""The modes of the pick-and-place motion primitive, and its heights, speeds and thresholds."""

import enum
from dataclasses import dataclass, field, replace

from systems.bounds import bounded
from systems.hand_motion import MotionLimits
from systems.insertion_search import InsertionSearch


class Mode(enum.IntEnum):
    """The planner's modes. The order to DONE is that of a successful pick and place."""

    OBSERVE = 0
    """Wait out of the cameras' sight, and ask the policy."""
    APPROACH = 1
    """Move to just above the pick, and open the jaws."""
    DESCEND = 2
    """Go down to the grasp height, or until something is touched."""
    CLOSE = 3
    """Close the jaws until they stall, then press."""
    CHECK = 4
    """Look whether there is something between the pads."""
    LIFT = 5
    """Go up until the object clears everything."""
    CARRY = 6
    """Move to just above the place, and rotate."""
    LOWER = 7
    """Go down until something is touched."""
    RELEASE = 8
    RETREAT = 9
    """Go up, and out of the cameras' sight."""
    DONE = 10
    SEARCH = 11
    """Insertion was blocked: feel for the cavity, see `InsertionSearch`."""


@dataclass
class PickPlaceParameters:
    """Heights, speeds and thresholds of the motion primitive."""

    # Where the hand waits while the cameras look: x, y, height of the fingertips (m), yaw (rad).
    # There it begins; later it returns to this x and height, and keeps its y and yaw. It has to be
    # out of the cameras' sight: the default is for the three default cameras. Below a camera that
    # looks straight down choose another, such as [-0.4, 0, 0.4, 0], or o_t lacks what it hides.
    home: list[float] = bounded([0.5, 0.0, 0.4, 0.0], -2.0, 2.0)

    # What crosses the table, fingertips or what hangs below them, stays this far above the highest
    # surface of o_t, in m ...
    travel_clearance: float = bounded(0.015, 0.0, 0.1)

    # ... and comes down fast to this far above what o_t shows around its goal, in m.
    hover_clearance: float = bounded(0.010, 0.001, 0.1)

    # How far below the top of an object the fingertips grip, in m: this share of its height above
    # its support, within these limits. On a round handle the pads are to be near its widest.
    grasp_depth: float = bounded(0.010, 0.001, 0.05)
    max_grasp_depth: float = bounded(0.018, 0.001, 0.05)
    grasp_depth_share: float = bounded(0.4, 0.0, 1.0)

    # The fingertips stay this far above the table, in m.
    floor_clearance: float = bounded(0.0015, 0.0, 0.05)

    # Opening of the jaws before a grasp, in m.
    open_width: float = bounded(0.080, 0.005, 0.080)

    # How far each jaw draws back from an object to let go of it, in m.
    release_clearance: float = bounded(0.006, 0.001, 0.04)

    # How hard each pad presses on what it holds, in N.
    grasp_force: float = bounded(30.0, 1.0, 140.0)

    # The same once the wrist has felt more than `heavy_load` of it, both in N: gripped beside its
    # centre of mass, what is heavy would rotate between the pads. 70 N is the continuous grasping
    # force of a Franka Hand.
    firm_grasp_force: float = bounded(70.0, 1.0, 140.0)
    heavy_load: float = bounded(5.0, 0.5, 100.0)

    # Less than this between the pressing pads is nothing at all, in m. They dent what is thin.
    minimum_width: float = bounded(0.0015, 0.0, 0.08)

    # How hard the closed jaws press an object down that is not seated, in N, and how far below its
    # top they may go, in m. They come down at `lower_speed`, at which merely to touch it means some
    # 25 N, and go beyond what is asked for by some 5 N.
    press_force: float = bounded(30.0, 1.0, 140.0)
    press_depth: float = bounded(0.020, 0.001, 0.05)

    # A vertical contact force beyond the payload's weight that means "touched", in N.
    contact_threshold: float = bounded(4.0, 0.5, 100.0)

    # Highest linear speed (m/s) and acceleration (m/s^2) in free space, in the plane and along z
    # each. An arm's joints may not be able to follow: nothing here knows of joints.
    linear_speed: float = bounded(1.2, 0.01, 1.2)
    linear_acceleration: float = bounded(8.0, 0.1, 9.0)

    # The same with an object in the hand.
    carry_speed: float = bounded(1.2, 0.01, 1.2)
    carry_acceleration: float = bounded(5.0, 0.1, 9.0)

    # Highest yaw speed (rad/s) and acceleration (rad/s^2).
    yaw_speed: float = bounded(2.5, 0.01, 2.5)
    yaw_acceleration: float = bounded(20.0, 0.1, 25.0)

    # Highest speed of the two guarded motions, in m/s.
    descend_speed: float = bounded(0.20, 0.005, 1.0)
    lower_speed: float = bounded(0.08, 0.005, 1.0)

    # What the hand does where an insertion is blocked. Only for places that are insertions.
    search: InsertionSearch = field(default_factory=InsertionSearch)

    # Speed of one finger, in m/s.
    finger_speed: float = bounded(0.05, 0.005, 0.05)

    # Time in which the grasp force builds up, and falls away again, in s. A heavy object that is
    # let go of slowly swings about the pads.
    force_ramp: float = bounded(0.03, 0.0, 5.0)

    # The hand must rest this long, in s: before the cameras look, and before the payload is tared.
    observe_settle: float = bounded(0.10, 0.0, 10.0)
    tare_settle: float = bounded(0.10, 0.0, 10.0)

    # After this many actions the planner is done, whatever the policy says; null: the task's.
    max_actions: int | None = bounded(None, 0, 1000)

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
            speed=min(self.search.speed, self.lower_speed),
            yaw_speed=min(self.search.yaw_speed, self.yaw_speed),
        )
        return limits
