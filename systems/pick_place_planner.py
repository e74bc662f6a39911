"""The pick-and-place motion primitive: a state machine that makes smooth, limited motions."""

import dataclasses
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.common.containers import namedview
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.hand_motion import (
    MotionLimits,
    braking_time,
    motion_at,
    motion_duration,
    ramp,
)
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.signals import PickPlaceAction, PlanarPose, wrap_to_pi

_FIELDS = (
    ["mode", "start_time", "duration"]
    + [f"start_{axis}" for axis in ("x", "y", "z", "yaw")]
    + [f"goal_{axis}" for axis in ("x", "y", "z", "yaw")]
    + [f"start_rate_{axis}" for axis in ("x", "y", "z", "yaw")]
    + ["start_opening", "goal_opening", "start_force", "goal_force"]
    + ["pick_x", "pick_y", "pick_yaw", "place_x", "place_y", "place_yaw", "grasp_z"]
    + ["hold_z", "rim_height", "touch_z", "swing"]
    + ["load", "actions", "missed", "dropped"]
)
_PlannerState = namedview("PlannerState", _FIELDS)
_State: TypeAlias = Any
"""A `_PlannerState`, which is made at run time and is no type to a type checker."""

_START, _GOAL, _START_RATE = slice(3, 7), slice(7, 11), slice(11, 15)

_SUNK = 0.0007
"""What is lowered and touches something is blocked unless it is this far below the rim, in m."""
_PRESS = 0.001
"""While searching, the hand is to be this far below where it was stopped, in m: its stiffness makes
a light pressure of it."""
_SWINGS = (0.5, -0.5, 1.0, -1.0, 0.0)
"""Where the search turns to, in parts of `search_turn`."""
_SWING_SPEED = 0.3
"""In rad/s: the free space around a tool is about 3 degrees wide, and is not to be missed."""


def nearest_turns(pick_yaw: float, place_yaw: float) -> tuple[float, float]:
    """The equivalent yaws that keep the wrist nearest its middle.

    The jaws are alike, so both yaws may be turned by pi together, and either by a whole turn.

    Returns:
        (pick, place) in radians, the larger of whose magnitudes is smallest.
    """
    candidates = []
    for half_turn in (0.0, np.pi):
        pick, place = wrap_to_pi(pick_yaw + half_turn), wrap_to_pi(place_yaw + half_turn)
        candidates.append((pick, place))
    return min(candidates, key=lambda yaws: max(abs(yaws[0]), abs(yaws[1])))


class PickPlacePlanner(LeafSystem):
    """Carries out one pick and place after another.

    .. pydrake_system::

        name: PickPlacePlanner
        input_ports:
        - hand_state
        - hand_contact_force
        - action
        output_ports:
        - desired_motion
        - desired_opening
        - closing_force
        - mode
        - counts

    - `hand_state` (12): positions then velocities of (x, y, z, yaw, left finger, right finger).
    - `hand_contact_force` (6): contact as generalized force on the same coordinates, in N and N m:
      what a force-torque sensor at the wrist and one in each finger would read. Up is positive.
    - `action` (abstract, `PickPlaceAction`): evaluated only at the moment in which the planner,
      at rest at home, asks for it. Nothing upstream (policy, cameras) is computed at other times.
    - `desired_motion` (12): q_d, v_d, a_d of (x, y, z, yaw).
    - `desired_opening` (2): the opening between the pads in m, and its rate.
    - `closing_force` (1): what each pad presses beyond that, in N.
    - `mode` (1): a `Mode`.
    - `counts` (3): actions begun, grasps missed, objects dropped.

    Every motion is a straight line in (x, y, z, yaw) with a minimum-jerk profile, at rest at both
    ends (a `RETREAT` from an object that was lost brakes first), as short as the limits on speed
    and acceleration allow. The two guarded motions, `DESCEND`
    and `LOWER`, stop dead where the vertical contact force rises `contact_threshold` above what the
    load weighs, and hold the height reached: no known height of table, kit or cavity tells them
    where to stop. Where the action says how high the rim of the cavity is, and the object, which
    lay on the table z = 0, comes to stand on it, the hand feels for the cavity (`SEARCH`) and
    lowers again once the resistance ends. A grasp is good if the pads stand further apart than
    `minimum_width` and both feel at least half of the grasp force; when it is not, or is lost on
    the way, the hand rises, opens on the way home and looks again, which counts as an action.

    All memory is one vector of discrete state.
    """

    def __init__(self, *, parameters: PickPlaceParameters, period: float = 1 / 64) -> None:
        """
        Args:
            parameters: heights, speeds, thresholds.
            period: how often the state machine looks, in s.
        """
        super().__init__()
        self._parameters = parameters
        self._motions = _motions(parameters)
        model = np.zeros(len(_FIELDS))
        state = _PlannerState(model)
        state[_START] = state[_GOAL] = parameters.home
        state.start_opening = state.goal_opening = parameters.open_width
        self._state_index = self.DeclareDiscreteState(model)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

        self._hand_state = self.DeclareVectorInputPort("hand_state", 12)
        self._contact_force = self.DeclareVectorInputPort("hand_contact_force", 6)
        self._action = self.DeclareAbstractInputPort("action", Value(PickPlaceAction()))
        state_and_time = {self.discrete_state_ticket(self._state_index), self.time_ticket()}
        self.DeclareVectorOutputPort("desired_motion", 12, self._calc_motion, state_and_time)
        self.DeclareVectorOutputPort("desired_opening", 2, self._calc_opening, state_and_time)
        self.DeclareVectorOutputPort("closing_force", 1, self._calc_force, state_and_time)
        state_only = {self.discrete_state_ticket(self._state_index)}
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, state_only)
        self.DeclareVectorOutputPort("counts", 3, self._calc_counts, state_only)

    def mode(self, context: Context) -> Mode:
        """What the planner is doing in the given context (its own)."""
        return Mode(int(self._state(context).mode))

    def action(self, context: Context) -> tuple[PlanarPose, PlanarPose]:
        """Pick and place of the action begun last, as the hand goes there (its own context)."""
        state = self._state(context)
        return (
            PlanarPose(float(state.pick_x), float(state.pick_y), float(state.pick_yaw)),
            PlanarPose(float(state.place_x), float(state.place_y), float(state.place_yaw)),
        )

    def _state(self, context: Context) -> _State:
        return _PlannerState(context.get_discrete_state(self._state_index).get_value())

    # Outputs.

    def _calc_motion(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector(_motion_at(state, context.get_time()))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector(
            ramp(
                state.start_opening,
                state.goal_opening,
                2 * self._parameters.finger_speed,
                context.get_time() - state.start_time,
            )
        )

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        fraction = 1.0
        if self._parameters.force_ramp > 0:
            elapsed = context.get_time() - state.start_time
            fraction = min(max(elapsed / self._parameters.force_ramp, 0.0), 1.0)
        output.SetFromVector(
            [state.start_force + fraction * (state.goal_force - state.start_force)]
        )

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._state(context).mode])

    def _calc_counts(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector([state.actions, state.missed, state.dropped])

    # The state machine.

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = _PlannerState(discrete_state.get_mutable_value(self._state_index))
        time = context.get_time()
        hand = self._hand_state.Eval(context)
        contact = self._contact_force.Eval(context)
        mode = Mode(int(state.mode))
        step = {
            Mode.OBSERVE: self._observe,
            Mode.DESCEND: self._descend,
            Mode.CLOSE: self._close,
            Mode.CHECK: self._check,
            Mode.LIFT: self._hold,
            Mode.CARRY: self._hold,
            Mode.LOWER: self._lower,
            Mode.SEARCH: self._search,
        }.get(mode, self._follow)
        if mode != Mode.DONE:
            step(context, state, time, hand, contact)
        return EventStatus.Succeeded()

    def _observe(self, context, state, time, hand, contact) -> None:
        if time < self._arrival(state) + self._parameters.observe_settle:
            return
        if state.actions >= self._parameters.max_actions:
            self._begin(state, Mode.DONE, time)
            return
        action: PickPlaceAction = self._action.Eval(context)
        if action.stop:
            self._begin(state, Mode.DONE, time)
            return
        pick_yaw, place_yaw = nearest_turns(action.pick.theta, action.place.theta)
        state.pick_x, state.pick_y, state.pick_yaw = action.pick.x, action.pick.y, pick_yaw
        state.place_x, state.place_y, state.place_yaw = action.place.x, action.place.y, place_yaw
        state.grasp_z = max(
            action.surface_height - self._parameters.grasp_depth, self._parameters.floor_clearance
        )
        # No height is above NaN.
        state.rim_height = np.nan if action.rim_height is None else action.rim_height
        state.swing = 0
        state.actions += 1
        self._begin(state, Mode.APPROACH, time)

    def _follow(self, context, state, time, hand, contact) -> None:
        if time >= self._arrival(state):
            following = Mode.OBSERVE if state.mode == Mode.RETREAT else Mode(int(state.mode) + 1)
            self._begin(state, following, time)

    def _descend(self, context, state, time, hand, contact) -> None:
        if contact[2] > self._parameters.contact_threshold:
            self._begin(state, Mode.CLOSE, time, z=hand[2])
            # Back off a little: pressed fingertips would not close.
            state.goal_z += self._parameters.floor_clearance
            state.duration = motion_duration(
                state[_GOAL] - state[_START], self._motions[Mode.CLOSE]
            )
        elif time >= self._arrival(state):
            self._begin(state, Mode.CLOSE, time)

    def _close(self, context, state, time, hand, contact) -> None:
        opening, rate = hand[4] + hand[5], hand[10] + hand[11]
        moving_for = time - state.start_time
        # The command runs ahead of stalled jaws by what the fingers' spring makes of it.
        commanded, _ = self.get_output_port(1).Eval(context)
        stalled = moving_for > 0.1 and abs(rate) < 2e-3 and commanded < opening - 1e-3
        if stalled or commanded <= 0.0:
            self._begin(state, Mode.CHECK, time, opening=opening)

    def _check(self, context, state, time, hand, contact) -> None:
        if time < self._arrival(state) + self._parameters.weigh_settle:
            return
        if self._is_held(hand, contact):
            state.hold_z = hand[2]
            self._begin(state, Mode.LIFT, time)
        else:
            state.missed += 1
            self._begin(state, Mode.RETREAT, time)

    def _hold(self, context, state, time, hand, contact) -> None:
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._begin(state, Mode.RETREAT, time)
        elif state.mode == Mode.LIFT and time >= self._arrival(state):
            self._begin(state, Mode.CARRY, time)
        elif time >= self._arrival(state) + self._parameters.weigh_settle:
            state.load = contact[2]
            self._begin(state, Mode.LOWER, time)

    def _lower(self, context, state, time, hand, contact) -> None:
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._begin(state, Mode.RETREAT, time)
        elif contact[2] - state.load > self._parameters.contact_threshold:
            if self._is_blocked(state, hand):
                state.touch_z = hand[2]
                self._begin(state, Mode.SEARCH, time, z=hand[2])
            else:
                self._begin(state, Mode.RELEASE, time, z=hand[2])
        elif time >= self._arrival(state):
            self._begin(state, Mode.RELEASE, time)

    def _search(self, context, state, time, hand, contact) -> None:
        free = contact[2] - state.load < self._parameters.contact_threshold / 2
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._begin(state, Mode.RETREAT, time)
        elif free and hand[2] < state.touch_z - _PRESS / 2:
            # Given a height, it stops dead: here the object fits.
            self._begin(state, Mode.LOWER, time, z=hand[2])
        elif time >= self._arrival(state):
            state.swing += 1
            if state.swing < len(_SWINGS):
                self._begin(state, Mode.SEARCH, time)
            else:
                self._begin(state, Mode.RELEASE, time, z=hand[2])

    def _is_blocked(self, state: _State, hand: NDArray[np.float64]) -> bool:
        # When it was grasped, it lay on the table.
        bottom = hand[2] - state.hold_z
        left = state.swing < len(_SWINGS) and self._parameters.search_turn > 0
        return bool(left and bottom > state.rim_height - _SUNK)

    def _is_held(self, hand: NDArray[np.float64], contact: NDArray[np.float64]) -> bool:
        # Contact pushes the fingers apart: along their positive axes.
        pressed = contact[4:6].min() > self._parameters.grasp_force / 2
        return bool(pressed and hand[4] + hand[5] > self._parameters.minimum_width)

    def _begin(
        self,
        state: _State,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
    ) -> None:
        """Starts a mode from where the commands now stand.

        Args:
            state: the planner's state, written.
            mode: the mode to begin.
            time: now, in s.
            z: hold the fingertips at this height from now on, in m.
            opening: hold the jaws at this opening from now on, in m.
        """
        parameters = self._parameters
        now, rate, _ = np.split(_motion_at(state, time), 3)
        now_opening, _ = ramp(
            state.start_opening,
            state.goal_opening,
            2 * parameters.finger_speed,
            time - state.start_time,
        )
        if z is not None:
            now[2] = z
            rate = np.zeros(4)
        if opening is not None:
            now_opening = opening
        state.start_force = state.goal_force
        state.mode = mode
        state.start_time = time
        state[_START] = now
        state[_GOAL] = now
        state[_START_RATE] = rate
        state.start_opening = state.goal_opening = now_opening

        if mode == Mode.OBSERVE:
            state[_GOAL] = parameters.home
            state.goal_opening = parameters.open_width
        elif mode == Mode.APPROACH:
            state[_GOAL] = (state.pick_x, state.pick_y, parameters.travel_height, state.pick_yaw)
        elif mode == Mode.DESCEND:
            state.goal_z = state.grasp_z
        elif mode == Mode.CLOSE:
            state.goal_opening = 0.0
        elif mode == Mode.CHECK:
            state.goal_force = parameters.grasp_force
        elif mode == Mode.LIFT:
            state.goal_z = parameters.travel_height
        elif mode == Mode.CARRY:
            state[_GOAL] = (state.place_x, state.place_y, parameters.travel_height, state.place_yaw)
        elif mode == Mode.LOWER:
            state.goal_z = parameters.floor_clearance
        elif mode == Mode.SEARCH:
            state.goal_yaw = state.place_yaw + _SWINGS[int(state.swing)] * parameters.search_turn
            state.goal_z = state.touch_z - _PRESS
        elif mode in (Mode.RELEASE, Mode.RETREAT):
            state.goal_force = 0.0
            state.goal_opening = min(
                now_opening + 2 * parameters.release_clearance, parameters.open_width
            )
            if mode == Mode.RETREAT:
                state.goal_opening = now_opening
                state.goal_z = parameters.travel_height
        limits = self._motions[mode]
        state.duration = max(
            motion_duration(state[_GOAL] - state[_START], limits), braking_time(rate, limits)
        )
        if mode == Mode.RETREAT:
            # Called off on the way: come to rest where braking ends.
            state[_GOAL] += rate * state.duration / 2 * np.array([1.0, 1.0, 0.0, 1.0])

    def _arrival(self, state: _State) -> float:
        """When the motion, the jaws and the force of the present mode have arrived, in s."""
        opening_time = abs(state.goal_opening - state.start_opening) / (
            2 * self._parameters.finger_speed
        )
        force_time = self._parameters.force_ramp * (state.goal_force != state.start_force)
        return float(state.start_time + max(state.duration, opening_time, force_time))


def _motions(parameters: PickPlaceParameters) -> dict[Mode, MotionLimits]:
    """The limits of each mode's motion."""
    yaw = (parameters.yaw_speed, parameters.yaw_acceleration)
    free = MotionLimits(parameters.linear_speed, parameters.linear_acceleration, *yaw)
    carry = MotionLimits(parameters.carry_speed, parameters.carry_acceleration, *yaw)
    limits = dict.fromkeys(Mode, free)
    limits[Mode.LIFT] = limits[Mode.CARRY] = carry
    limits[Mode.DESCEND] = MotionLimits(
        parameters.descend_speed, parameters.linear_acceleration, *yaw
    )
    limits[Mode.LOWER] = MotionLimits(parameters.lower_speed, parameters.carry_acceleration, *yaw)
    limits[Mode.SEARCH] = dataclasses.replace(
        limits[Mode.LOWER], yaw_speed=min(_SWING_SPEED, parameters.yaw_speed)
    )
    return limits


def _motion_at(state: _State, time: float) -> NDArray[np.float64]:
    """q_d, v_d, a_d (12) of the present mode's motion."""
    return motion_at(
        state[_START], state[_GOAL], state[_START_RATE], state.duration, time - state.start_time
    )
