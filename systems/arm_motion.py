"""A Franka arm's motion in each mode of the pick-and-place motion primitive."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from systems.arm_collisions import Capsule
from systems.arm_inertia import ArmInertia
from systems.arm_kinematics import ArmBase, fingertips
from systems.arm_limits import JOINTS, ArmLimits
from systems.arm_postures import ArmPostures, HandStop
from systems.arm_reach import hand_stops
from systems.arm_stop import ArmStop
from systems.arm_way import ArmWay, WayVector
from systems.floating_hand_motion import TRIAL
from systems.guarded_marks import guarded_marks
from systems.jaw_motion import JawMotion
from systems.motion_heights import MotionHeights
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import PlannerState
from systems.signals import PlanarPose
from systems.vector_view import Array, Number

_KEPT = 8
"""Number of planned motions that are cached."""
_FARTHEST_STOP = 0.02
"""The arm stops at a given pose or height only if the hand is at most this far from it, in m.
Otherwise the arm brakes where it is."""
_SAME_HEIGHT = 0.003
"""A height counts as reached when the hand is at most this far below it, in m."""

_HELD_REACH = 0.125
"""A held object reaches at most this far from the fingertips, in m. `read_surface_heights` assumes
the same."""
_RISES_WITHIN = 0.05
"""Within this horizontal distance of the pick, in m, the hand rises from it, or sinks to it."""
_TOO_LOW = 0.010
"""A motion is not begun if the hand would sink below the clear height by more than this, in m."""
_CAREFUL_SPEED = 0.02
"""Upper limit of `contact_speed` for an arm, in m/s, if the heights are uncertain: then it may
touch something where nothing is expected."""
_TOUCH_SPEED = 0.011
"""Upper limit of `touch_speed` for an arm, in m/s. The force of an impact is proportional to mass
times speed. The mass that moves with an arm's hand is 10 to 25 kg; with the floating hand it is 4
kg."""


class ArmState(PlannerState):
    """The planner's state, with the additional fields that an arm needs."""

    way = Array(WayVector.size)
    """The `WayVector` of the present motion."""
    way_start = Number()
    """The time at which the present motion began, in s."""
    pick_joints = Array(JOINTS)
    """Joint positions with the hand above the pick, in rad. `place_joints` are those with the hand
    above the place."""
    place_joints = Array(JOINTS)


class ArmMotion(JawMotion):
    """Implements `RobotMotion` for an arm.

    - `APPROACH`, `LIFT` with `CARRY`, `RETREAT`: motions in joint space, as fast as the joints'
      limits and the parameters' linear speed and acceleration allow. The hand rises straight up to
      the clear height (with an object: the travel height; see `MotionHeights`), crosses above it,
      and sinks only near its goal. Corners are rounded.
    - `DESCEND`, `LOWER`, `SEARCH`: straight lines of the hand, with the parameters' speeds.
    - If a mode begins while the arm moves, the arm first brakes, as fast as the limits of
      acceleration and jerk allow. The exception is `CARRY` after `LIFT`: these two are one motion.

    Position, velocity, acceleration and jerk of all joints are within their limits at all times.

    A motion is a pure function of the `WayVector` in the state. The latest motions are cached.
    """

    size = 3 * JOINTS
    settles = 0.04

    def __init__(
        self,
        parameters: PickPlaceParameters,
        limits: ArmLimits,
        base: ArmBase,
        obstacles: Sequence[Capsule] = (),
        highest_wait: float = math.inf,
        inertia: ArmInertia | None = None,
    ) -> None:
        """
        Args:
            parameters: heights, speeds and forces of the motion primitive.
            limits: limits of the joints.
            base: pose of the arm's base in the world.
            obstacles: capsules around fixed bodies that the arm must not touch, in the world.
            highest_wait: upper limit of the height at which the hand waits, in m.
            inertia: model of the arm's inertia; if None, torque rates are not limited.

        Raises:
            ValueError: the arm cannot reach the home pose.
        """
        super().__init__(parameters)
        self._limits, self._inertia = parameters.motion_limits(), inertia
        self.postures = ArmPostures(limits, base, obstacles)
        x, y, z, yaw = parameters.home
        z = self._wait_height = min(z, highest_wait)
        home = HandStop("home", x, y, yaw, low=z, high=z, surface=base.z - 1.0)
        middle = (np.array(limits.lower) + limits.upper) / 2
        found, problem = self.postures.choose([home], middle)
        if problem:
            raise ValueError(f"planner.home: {problem}")
        self.home_joints = found[0]
        """(7) joint positions in which the arm waits at first, in rad."""
        self._way_of = functools.lru_cache(maxsize=_KEPT)(self._make_way)

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the arm waits at home with open jaws."""
        vector = np.zeros(ArmState.size)
        state = ArmState(vector)
        state.way = np.nan
        WayVector(state.way).start = [*self.home_joints, *[0.0] * (2 * JOINTS)]
        self.open(state)
        return vector

    def view(self, vector: NDArray[np.float64]) -> ArmState:
        """Returns a view of a state vector with named fields. See `RobotMotion`."""
        return ArmState(vector)

    def _make_way(self, vector: bytes) -> ArmWay:
        return ArmWay(np.frombuffer(vector), self.postures, self._inertia)

    def _way(self, state: PlannerState) -> ArmWay:
        assert isinstance(state, ArmState)
        return self._way_of(state.way.tobytes())

    def stops(self, state: PlannerState) -> list[HandStop]:
        """The places at which the hand goes down in the present action."""
        heights = MotionHeights(
            grasp=state.grasp_z,
            clear=state.clear_z,
            travel=state.travel_z,
            pick_hover=state.pick_hover_z,
            place_hover=state.place_hover_z,
        )
        pick, place = (PlanarPose(*pose.tolist()) for pose in (state.pick, state.place))
        return hand_stops(
            pick,
            None if state.press else place,
            heights,
            state.table_z,
            self._parameters,
            (state.around_pick_z, state.around_place_z),
            state.floor_z + max(state.grasp_z - state.support_z, 0.0),
        )

    def reach_problem(self, state: PlannerState) -> str:
        """A sentence that says why the arm cannot do the action in the state; empty if it can."""
        return self._prepare(self.view(np.array(state.vector)))

    def prepare(self, state: PlannerState) -> bool:
        """Chooses the joint positions at pick and place. Returns whether the arm can do the
        action."""
        return not self._prepare(self.view(state.vector))

    def _prepare(self, state: ArmState) -> str:
        """Chooses the joint positions for `prepare`. Returns the sentence of `reach_problem`."""
        now = self._way(state).at(math.inf)[:JOINTS]
        found, problem = self.postures.choose(self.stops(state), now)
        if problem:
            return problem
        state.pick_joints, state.place_joints = found[0], found[-1]
        state.pick[2] = self.postures.hand_pose(found[0])[3]
        state.place[2] = self.postures.hand_pose(found[-1])[3]
        return self._problem_on_the_ways(state)

    def _problem_on_the_ways(self, state: ArmState) -> str:
        """A sentence that names what the arm would touch on the planned motions; empty if
        it touches nothing."""
        trial = self.view(np.array(state.vector))
        now = self._way(trial).at(math.inf)
        highest = float(state.clear_z) - self._parameters.travel_clearance
        at_pick, at_place = float(state.around_pick_z), float(state.around_place_z)
        last = at_pick if state.press else at_place
        ways = [
            (Mode.APPROACH, "pick", at_pick),
            (Mode.DESCEND, "pick", at_pick),
            (Mode.RETREAT, "home", last),
        ]
        if not state.press:
            ways.insert(2, (Mode.LIFT, "place", max(at_pick, at_place)))
        for mode, name, most in ways:
            self._set_way(trial, mode, now, None, None)
            way = self._way(trial)
            now = way.at(math.inf)
            held = _HELD_REACH if mode == Mode.LIFT else 0.0
            positions = way.positions()
            tips = self.postures.base.to_world(fingertips(positions))
            rises = np.linalg.norm(tips[:, :2] - state.pick[:2], axis=1) < _RISES_WITHIN
            surface = np.where(rises, at_pick, most)
            touched = self.postures.collision(positions, surface, held, highest)
            if touched:
                return f"on the way to the {name} the arm would collide with {touched}"
            if way.missing > _TOO_LOW:
                return f"on the way to the {name} the hand would sink into what lies there"
        return ""

    def begin(
        self,
        state: PlannerState,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
        at: NDArray[np.float64] | None = None,
    ) -> None:
        """Starts a mode from the motion that is commanded now. See `RobotMotion`."""
        assert isinstance(state, ArmState)
        goes_on = mode == Mode.CARRY and state.mode == Mode.LIFT
        now = self.motion_at(state, time)
        self.begin_jaws(state, mode, time, opening)
        state.mode, state.start_time = mode, time
        if not goes_on:
            state.way_start = time
            self._set_way(state, mode, now, z, at)
        state.duration = state.way_start + self._way(state).duration - time

    def _set_way(
        self,
        state: ArmState,
        mode: Mode,
        now: NDArray[np.float64],
        z: float | None,
        at: NDArray[np.float64] | None,
    ) -> None:
        state.way = np.nan
        way, limits = WayVector(state.way), self._limits[mode]
        way.start = now
        way.speed, way.acceleration = limits.speed, limits.acceleration
        if mode == Mode.APPROACH:
            if not state.refused:
                way.over, way.clear, way.sink = state.pick_joints, state.clear_z, state.pick_hover_z
        elif mode == Mode.LIFT and state.doubts_grip:
            # Lift a little as a trial, to measure how the object's weight pulls on the hand. A hand
            # that already rises must not come down again.
            q, v, a = now.reshape(3, -1)
            stop = ArmStop(q, v, a, self.postures.limits, self._inertia)
            way.line = self.postures.hand_pose(stop.goal)
            way.line[2] = max(state.hold_z + TRIAL, float(way.line[2]))
            way.speeds, way.yaw_speed = limits.speed, limits.yaw_speed
        elif mode in (Mode.LIFT, Mode.CARRY):
            way.over, way.clear, way.sink = state.place_joints, state.travel_z, state.place_hover_z
            way.reach = _HELD_REACH
        elif mode == Mode.RETREAT:
            self._set_retreat(state, way)
        else:
            self._set_line(state, way, mode, z, at)

    def _set_line(
        self,
        state: ArmState,
        way: WayVector,
        mode: Mode,
        z: float | None,
        at: NDArray[np.float64] | None,
    ) -> None:
        """Sets the motion to a straight line of the hand that begins where the arm has stopped."""
        parameters, limits = self._parameters, self._limits[mode]
        pose = self.postures.hand_pose(way.start[:JOINTS])
        goal = np.array(pose)
        slow = min(limits.speed, parameters.contact_speed)
        if state.doubt > 0:
            slow = min(slow, _CAREFUL_SPEED)
        way.speeds, way.yaw_speed = slow, limits.yaw_speed
        if mode in (Mode.DESCEND, Mode.LOWER):
            goal[2] = state.table_z + parameters.floor_clearance
            if mode == Mode.DESCEND:
                goal[2] = state.grasp_z
                if state.press:
                    goal[2] = state.pick_top_z - parameters.press_depth
            way.marks = guarded_marks(state, mode, parameters)
            way.speeds = limits.speed, slow, min(slow, parameters.touch_speed, _TOUCH_SPEED)
        elif mode == Mode.SEARCH:
            x, y, yaw = parameters.search.offset(int(state.search_step))
            goal[:2] = state.place[0] + x, state.place[1] + y
            goal[3] = state.place[2] + yaw
            goal[2] = state.touch_z - parameters.search.press
            way.marks = math.inf, -math.inf
        elif at is not None:
            if np.linalg.norm(at[:3] - pose[:3]) > _FARTHEST_STOP:
                return
            goal = np.array(at)
        elif z is not None and abs(z - pose[2]) < _FARTHEST_STOP:
            # A payload makes the hand sag below its command. A goal at the sagged height would push
            # the hand further down.
            goal[2] = max(z, float(pose[2]))
        else:
            return
        way.line = goal

    def _set_retreat(self, state: ArmState, way: WayVector) -> None:
        """Sets a motion that rises and then returns to the x of the home pose. The home's y and yaw
        need not be reached."""
        now = way.start[:JOINTS]
        y = float(self.postures.hand_pose(now)[1])
        way.sink = max(self._wait_height, float(state.travel_z))
        way.over = self.waiting_joints(y, now, float(state.table_z), float(way.sink))
        # After a stop by the force guard the jaws may drag an object along, so rise to the higher
        # travel height.
        way.clear = state.travel_z if state.stops else state.clear_z
        # Do not turn joint 7 to the home yaw, because the other joints would have to wait for it.
        way.over[6] = now[6]

    def waiting_joints(
        self, y: float, now: NDArray[np.float64], surface: float, z: float | None = None
    ) -> NDArray[np.float64]:
        """Returns (7) joint positions, in rad, with the hand at the x of the home pose and as near
        to a given y as possible.

        Args:
            y: wanted y of the hand in the world, in m.
            now: (7) present joint positions, in rad.
            surface: height of the highest surface around the hand, in m.
            z: height of the fingertips, in m; if None, the height at which the hand waits.
        """
        x, home_y, _, yaw = self._parameters.home
        z = self._wait_height if z is None else z
        for share in (1.0, 0.75, 0.5, 0.25):
            between = home_y + share * (y - home_y)
            stop = HandStop("home", x, between, yaw, low=z, high=z, surface=surface)
            found, problem = self.postures.choose([stop], now)
            if not problem:
                return found[0]
        return self.home_joints

    def slow_down(self, state: PlannerState, time: float, share: float) -> None:
        """Does nothing: an arm keeps its acceleration, whatever it holds. See `RobotMotion`."""

    def back_off(self, state: PlannerState, distance: float) -> None:
        """Raises the goal of the present mode. See `RobotMotion`."""
        assert isinstance(state, ArmState)
        way = WayVector(state.way)
        if np.isfinite(way.line[2]):
            way.line[2] += distance
        state.duration = self._way(state).duration

    def motion_at(self, state: PlannerState, time: float) -> NDArray[np.float64]:
        """(21) the joints' desired positions, velocities and accelerations, in rad and s."""
        assert isinstance(state, ArmState)
        return self._way(state).at(time - state.way_start)

    def hand_acceleration(
        self, state: PlannerState, time: float, desired: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(3) acceleration of the fingertips in the world, in m/s^2."""
        assert isinstance(state, ArmState)
        return self._way(state).hand_acceleration(time - state.way_start)

    def arrival(self, state: PlannerState) -> float:
        """The time at which the present mode is complete. See `RobotMotion`."""
        assert isinstance(state, ArmState)
        return self.jaws_arrival(state, state.way_start + self._way(state).duration)

    def brakes_above(self, state: PlannerState, time: float, height: float) -> bool:
        """Whether the hand has reached a height, or the lift is complete. See `RobotMotion`."""
        q = self.motion_at(state, time)[:JOINTS]
        arrived = time >= self.arrival(state)
        return bool(arrived or self.postures.hand_pose(q)[2] >= height - _SAME_HEIGHT)
