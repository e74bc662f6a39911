"""The pick-and-place motion primitive: a state machine with smooth, limited motions."""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.attempt_history import AttemptHistory, LeftOverVector
from systems.contact_guard import ContactGuard
from systems.hand_geometry import check_reach
from systems.hand_motion import shortest_yaws
from systems.motion_heights import motion_heights
from systems.pick_place_motion import YAW, YAW_LIMIT, PickPlaceMotion, PlannerState, Z
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.signals import (
    STOP_REASONS,
    Observation,
    PickPlaceAction,
    PlanarPose,
    SurfaceHeights,
)
from systems.surface_heights import read_surface_heights
from systems.weak_calc import weak_calc

_HOLDING = (Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.SEARCH, Mode.RELEASE)
"""The modes in which an object may be in the hand."""


@dataclasses.dataclass(frozen=True)
class _Moment:
    """The inputs of one step of the state machine."""

    context: Context
    state: PlannerState
    """The state, which the step modifies."""
    time: float
    hand: NDArray[np.float64]
    """The port `hand_state`."""
    contact: NDArray[np.float64]
    """The port `hand_contact_force`."""


class PickPlacePlanner(LeafSystem):
    """Executes one pick and place after another.

    .. pydrake_system::

        name: PickPlacePlanner
        input_ports:
        - hand_state
        - hand_contact_force
        - action
        - observation (optional)
        output_ports:
        - desired_motion
        - desired_opening
        - closing_force
        - mode
        - counts
        - failed_picks
        - history
        - peak_force
        - asks
        - accepted_action

    - `hand_state` (12): positions then velocities of (x, y, z, yaw, left finger, right finger).
    - `hand_contact_force` (6): contact as generalized force on the same coordinates, in N and N m,
      as force-torque sensors at the wrist and in each finger would measure it. Up is positive.
    - `action` (abstract, `PickPlaceAction`): evaluated only when the planner, at rest out of the
      cameras' sight, needs an action. Policy and cameras are not evaluated at other times.
    - `observation` (abstract, `Observation`): o_t, evaluated together with the action if the
      action carries no heights. They are then read off o_t.
    - `desired_motion` (12): q_d, v_d, a_d of (x, y, z, yaw).
    - `desired_opening` (2): the opening between the pads in m, and its rate.
    - `closing_force` (1): additional force of each pad, in N.
    - `mode` (1): a `Mode`.
    - `counts` (4): actions begun, grasps missed, objects dropped, actions stopped by the guard.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): the last 16 picks where a grasp was missed
      or lost, an object pressed down, or the action stopped, latest last. A policy can use it to
      try another.
    - `history` (abstract, a tuple of `Attempt`): the last 64 actions whose outcome is decided,
      oldest first.
    - `peak_force` (3): the largest vertical and lateral contact force on the hand in the present or
      last action, without the weight of the held object, in N, as means over 1/64 s; and the
      `Mode` in which the larger of the two rose. See `ContactGuard`.
    - `asks` (1): 1 if the next update, due at the context's time, evaluates `action`; else 0.
    - `accepted_action` (abstract, `PickPlaceAction`): the last action begun, with the hand's actual
      yaws and without heights; or the stop, with up to 24 objects and cavities of `left_over`.

    Motions are smooth and as short as the limits on speed and acceleration allow (see
    `systems.hand_motion`). In the plane they are straight lines; height and yaw have their own time
    courses. When `CARRY` continues from an unfinished `LIFT`, only the velocity is continuous.

    - `LIFT`, `RETREAT`: the hand rises above the highest surface of o_t before it travels.
    - `APPROACH`, `CARRY`: near its goal, the hand sinks to just above the surfaces there.
    - `DESCEND`, `LOWER`: guarded motions. They stop dead when the vertical contact force exceeds
      the payload's weight by `contact_threshold`. The heights of table, kit and cavity need not be
      known, but where o_t shows a surface the hand slows down first, because the force of an impact
      is proportional to the speed.
    - `CHECK`: a grasp is good if the pads are further apart than `minimum_width` and both feel at
      least half of the grasp force. If it is not, or is lost later, the hand retreats and observes
      again. The attempt counts as an action.
    - `LIFT`, `CARRY`: a load above `heavy_load` is gripped more firmly.
    - `SEARCH`: in tasks that insert, if the object stands on the rim around its place, the hand
      searches for the cavity. It lowers again once the resistance ends.
    - An action with `press` ends with `DESCEND`, with closed jaws, at `touch_speed`, until
      `press_force` is reached.
    - In all modes, a contact force beyond `force_limit` ends the action (see `ContactGuard`): the
      hand stops dead, lets go of what it holds, and retreats. It counts as a failed pick.

    State (discrete): one vector, the history, and what a stopping policy left over.
    """

    def __init__(
        self,
        *,
        parameters: PickPlaceParameters,
        max_actions: int,
        insertion: bool = False,
        period: float = 1 / 64,
        force_period: float = 1 / 128,
    ) -> None:
        """
        Args:
            parameters: heights, speeds, thresholds.
            max_actions: stop after this many actions, unless `parameters.max_actions` overrides it.
            insertion: whether to search for a cavity when a place is blocked.
            period: update period of the state machine, in s.
            force_period: period at which the contact force is looked at, in s: the plant's step.
        """
        super().__init__()
        self._parameters = parameters
        given = parameters.max_actions
        self._max_actions = max_actions if given is None else given
        self._search_steps = parameters.search.steps if insertion else 0
        self._motion = PickPlaceMotion(parameters)
        self._state_index = self.DeclareDiscreteState(self._motion.initial_state())
        self._history_index = self.DeclareDiscreteState(np.full(AttemptHistory.size, np.nan))
        self._left_over_index = self.DeclareDiscreteState(np.zeros(LeftOverVector.size))
        self._guard = ContactGuard(parameters.force_limit, force_period)
        self._period = period
        # At times that they share, the first one declared comes first.
        self.DeclarePeriodicDiscreteUpdateEvent(force_period, 0.0, self._feel)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

        self._hand_state = self.DeclareVectorInputPort("hand_state", 12)
        self._contact_force = self.DeclareVectorInputPort("hand_contact_force", 6)
        self._action = self.DeclareAbstractInputPort("action", Value(PickPlaceAction()))
        self._observation = self.DeclareAbstractInputPort("observation", Value(Observation()))
        state_and_time = {self.discrete_state_ticket(self._state_index), self.time_ticket()}
        self._motion_port = self.DeclareVectorOutputPort(
            "desired_motion", 12, self._calc_motion, state_and_time
        )
        self.DeclareVectorOutputPort("desired_opening", 2, self._calc_opening, state_and_time)
        self.DeclareVectorOutputPort("closing_force", 1, self._calc_force, state_and_time)
        state_only = {self.discrete_state_ticket(self._state_index)}
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, state_only)
        self.DeclareVectorOutputPort("counts", 4, self._calc_counts, state_only)
        self.DeclareVectorOutputPort("peak_force", 3, self._calc_peak_force, state_only)
        self.DeclareVectorOutputPort("asks", 1, self._calc_asks, state_and_time)
        history = {self.discrete_state_ticket(self._history_index)}
        left_over = {self.discrete_state_ticket(self._left_over_index)}
        for name, empty, calc, tickets in (
            ("failed_picks", (), self._calc_failed_picks, history),
            ("history", (), self._calc_history, history),
            (
                "accepted_action",
                PickPlaceAction(),
                self._calc_accepted_action,
                state_only | left_over,
            ),
        ):
            self.DeclareAbstractOutputPort(
                name, functools.partial(Value, empty), weak_calc(calc), tickets
            )

    def _state(self, context: Context) -> PlannerState:
        return PlannerState(context.get_discrete_state(self._state_index).get_value())

    # Outputs.

    def _calc_motion(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector(self._motion.motion_at(state, context.get_time()))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector(self._motion.opening_at(state, context.get_time()))

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._motion.force_at(self._state(context), context.get_time())])

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._state(context).mode])

    def _calc_counts(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector([state.actions, state.missed, state.dropped, state.stopped])

    def _calc_peak_force(self, context: Context, output: BasicVector) -> None:
        state = self._state(context)
        output.SetFromVector([state.peak_vertical, state.peak_lateral, state.peak_mode])

    def _calc_failed_picks(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._history(context).failed_picks())

    def _calc_history(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._history(context).attempts())

    def _history(self, context: Context) -> AttemptHistory:
        return AttemptHistory(context.get_discrete_state(self._history_index).get_value())

    def _calc_asks(self, context: Context, output: BasicVector) -> None:
        state, time = self._state(context), context.get_time()
        asks = (
            state.mode == Mode.OBSERVE
            and state.actions < self._max_actions
            and self._has_settled(state, time)
            and math.remainder(time, self._period) == 0.0
        )
        output.SetFromVector([asks])

    def _calc_accepted_action(self, context: Context, output: AbstractValue) -> None:
        action = _action_of(self._state(context))
        if action.stop:
            kept = context.get_discrete_state(self._left_over_index).get_value()
            action = dataclasses.replace(action, left_over=LeftOverVector(kept).read())
        output.set_value(action)

    # The force guard.

    def _feel(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = PlannerState(discrete_state.get_mutable_value(self._state_index))
        mode = state.mode
        if mode in (Mode.OBSERVE, Mode.DONE):
            return EventStatus.DidNothing()
        hand = self._hand_state.Eval(context)
        motion = self._motion_port.Eval(context)
        peak = max(state.peak_vertical, state.peak_lateral)
        must_stop = self._guard.feel(
            state, self._contact_force.Eval(context), float(hand[2]), motion[8:11]
        )
        if must_stop and not state.stops:
            self._stop(state, context.get_time(), hand)
            self._conclude(mode, state, discrete_state)
        if state.mode == Mode.RETREAT and max(state.peak_vertical, state.peak_lateral) > peak:
            self._amend(state, discrete_state)
        return EventStatus.Succeeded()

    def _stop(self, state: PlannerState, time: float, hand: NDArray[np.float64]) -> None:
        """Stops dead, lets go of what is in the hand, and retreats."""
        state.stopped, state.stops = state.stopped + 1, 1
        retreats, holds = state.mode == Mode.RETREAT, state.mode in _HOLDING
        self._motion.begin(state, Mode.RELEASE if holds else Mode.RETREAT, time, at=hand[:4])
        if retreats:
            # The jaws drag something along.
            state.goal_opening = self._parameters.open_width

    # The state machine.

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = PlannerState(discrete_state.get_mutable_value(self._state_index))
        time = context.get_time()
        hand = self._hand_state.Eval(context)
        contact = self._contact_force.Eval(context)
        mode = Mode(int(state.mode))
        if mode != Mode.DONE:
            self._step(mode)(_Moment(context, state, time, hand, contact))
            self._conclude(mode, state, discrete_state)
        if mode == Mode.OBSERVE and state.mode == Mode.DONE and state.actions < self._max_actions:
            kept = discrete_state.get_mutable_value(self._left_over_index)
            LeftOverVector(kept).write(self._action.Eval(context).left_over)
        return EventStatus.Succeeded()

    def _conclude(self, before: float, state: PlannerState, discrete_state: DiscreteValues) -> None:
        """Writes an action into the history when the hand begins to retreat."""
        if state.mode != Mode.RETREAT:
            return
        if before == Mode.RETREAT:
            if state.stops:
                self._amend(state, discrete_state)
            return
        history = AttemptHistory(discrete_state.get_mutable_value(self._history_index))
        peak = max(state.peak_vertical, state.peak_lateral)
        history.append(_action_of(state), _outcome(before, state), peak)

    def _amend(self, state: PlannerState, discrete_state: DiscreteValues) -> None:
        """Updates the latest attempt of the history while the hand retreats."""
        history = AttemptHistory(discrete_state.get_mutable_value(self._history_index))
        outcome = "stopped" if state.stops else history.attempts()[-1].outcome
        history.amend(outcome, max(state.peak_vertical, state.peak_lateral))

    def _step(self, mode: Mode) -> Callable[[_Moment], None]:
        steps: dict[Mode, Callable[[_Moment], None]] = {
            Mode.OBSERVE: self._observe,
            Mode.DESCEND: self._descend,
            Mode.CLOSE: self._close,
            Mode.CHECK: self._check,
            Mode.LIFT: self._hold,
            Mode.CARRY: self._hold,
            Mode.LOWER: self._lower,
            Mode.SEARCH: self._search,
        }
        return steps.get(mode, self._follow)

    def _observe(self, moment: _Moment) -> None:
        context, state, time = moment.context, moment.state, moment.time
        if not self._has_settled(state, time):
            return
        spent = state.actions >= self._max_actions
        stop = PickPlaceAction(stop=True, reason="actions spent")
        action: PickPlaceAction = stop if spent else self._action.Eval(context)
        if action.stop:
            state.stop = 1 + list(STOP_REASONS).index(action.reason or "done")
            self._motion.begin(state, Mode.DONE, time)
            return
        check_reach(action)
        if action.press:
            action = dataclasses.replace(action, place=action.pick)
        pick_yaw, place_yaw = shortest_yaws(
            action.pick.theta, action.place.theta, float(state.goal[YAW]), YAW_LIMIT
        )
        state.pick = (action.pick.x, action.pick.y, pick_yaw)
        state.place = (action.place.x, action.place.y, place_yaw)
        self._set_heights(state, self._heights(context, action))
        state.search_step, state.press, state.aside = 0, action.press, action.aside
        state.stops = 0
        state.actions += 1
        self._guard.reset(state)
        self._motion.begin(state, Mode.APPROACH, time)

    def _has_settled(self, state: PlannerState, time: float) -> bool:
        """Whether the hand has rested out of sight for long enough to observe."""
        return time >= self._motion.arrival(state) + self._parameters.observe_settle

    def _heights(self, context: Context, action: PickPlaceAction) -> SurfaceHeights:
        if action.heights is not None:
            return action.heights
        if not self._observation.HasValue(context):
            raise RuntimeError(
                "the action has no heights: connect the planner's port `observation` to read them"
            )
        observation = self._observation.Eval(context)
        return read_surface_heights(observation, action.pick, action.place)

    def _set_heights(self, state: PlannerState, heights: SurfaceHeights) -> None:
        motion = motion_heights(heights, self._parameters)
        state.grasp_z, state.pick_top_z = motion.grasp, heights.pick_top
        state.table_z, state.support_z = heights.table, heights.support
        # An object slightly below an uncertain rim may stand on it.
        state.rim_z = heights.place_rim - heights.doubt
        state.floor_z, state.doubt = heights.place_floor, heights.doubt
        state.clear_z, state.travel_z = motion.clear, motion.travel
        state.pick_hover_z, state.place_hover_z = motion.pick_hover, motion.place_hover

    def _follow(self, moment: _Moment) -> None:
        state, time = moment.state, moment.time
        if time >= self._motion.arrival(state):
            following = Mode.OBSERVE if state.mode == Mode.RETREAT else Mode(int(state.mode) + 1)
            self._motion.begin(state, following, time)

    def _descend(self, moment: _Moment) -> None:
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if state.press:
            if contact[2] > self._parameters.press_force:
                # Stop dead: braking would press harder.
                self._motion.begin(state, Mode.RETREAT, time, z=hand[2])
            elif time >= self._motion.arrival(state):
                self._motion.begin(state, Mode.RETREAT, time)
        elif contact[2] > self._parameters.contact_threshold:
            self._motion.begin(state, Mode.CLOSE, time, z=hand[2])
            # Back off a little: the jaws cannot close while the fingertips press.
            state.goal[Z] += self._parameters.floor_clearance
            self._motion.set_times(state)
        elif time >= self._motion.arrival(state):
            self._motion.begin(state, Mode.CLOSE, time)

    def _close(self, moment: _Moment) -> None:
        state, time, hand = moment.state, moment.time, moment.hand
        opening, rate = hand[4] + hand[5], hand[10] + hand[11]
        moving_for = time - state.start_time
        # Stalled jaws lag behind the command by the deflection of the fingers' spring.
        commanded, _ = self._motion.opening_at(state, time)
        stalled = moving_for > 0.1 and abs(rate) < 2e-3 and commanded < opening - 1e-3
        if stalled or commanded <= 0.0:
            self._motion.begin(state, Mode.CHECK, time, opening=opening)

    def _check(self, moment: _Moment) -> None:
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if time < self._motion.arrival(state) + self._parameters.tare_settle:
            return
        if self._is_held(hand, contact):
            state.hold_z = hand[2]
            # Gripped higher than planned, the object hangs lower.
            higher = max(hand[2] - state.grasp_z, 0.0)
            state.travel_z += higher
            state.place_hover_z += higher
            self._motion.begin(state, Mode.LIFT, time)
        else:
            state.missed += 1
            self._motion.begin(state, Mode.RETREAT, time)

    def _hold(self, moment: _Moment) -> None:
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if -contact[2] > self._parameters.heavy_load:
            firm = max(state.goal_force, self._parameters.firm_grasp_force)
            self._motion.set_force(state, time, firm)
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._motion.begin(state, Mode.RETREAT, time)
        elif state.mode == Mode.LIFT:
            if self._motion.brakes_above(state, time, state.travel_z):
                self._motion.begin(state, Mode.CARRY, time)
        elif time >= self._motion.arrival(state) + self._parameters.tare_settle:
            self._guard.tare(state, contact, self._parameters.contact_threshold)
            self._motion.begin(state, Mode.LOWER, time)

    def _lower(self, moment: _Moment) -> None:
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._motion.begin(state, Mode.RETREAT, time)
        elif contact[2] - state.payload > self._parameters.contact_threshold:
            if self._is_blocked(state, hand):
                state.touch_z = hand[2]
                self._motion.begin(state, Mode.SEARCH, time, z=hand[2])
            else:
                self._motion.begin(state, Mode.RELEASE, time, z=hand[2])
        elif time >= self._motion.arrival(state):
            self._motion.begin(state, Mode.RELEASE, time)

    def _search(self, moment: _Moment) -> None:
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        free = contact[2] - state.payload < self._parameters.contact_threshold / 2
        if not self._is_held(hand, contact):
            state.dropped += 1
            self._motion.begin(state, Mode.RETREAT, time)
        elif free and self._parameters.search.has_slipped_in(hand[2], state.touch_z):
            # The object has found its cavity: stop here without braking, and lower it.
            self._motion.begin(state, Mode.LOWER, time, z=hand[2])
        elif time >= self._motion.arrival(state):
            state.search_step += 1
            if state.search_step < self._search_steps:
                self._motion.begin(state, Mode.SEARCH, time)
            else:
                self._motion.begin(state, Mode.RELEASE, time, z=hand[2])

    def _is_blocked(self, state: PlannerState, hand: NDArray[np.float64]) -> bool:
        bottom = hand[2] - state.hold_z + state.support_z
        left = state.search_step < self._search_steps
        search, rim, table = self._parameters.search, float(state.rim_z), float(state.table_z)
        return left and search.is_on_rim(float(bottom), rim, table)

    def _is_held(self, hand: NDArray[np.float64], contact: NDArray[np.float64]) -> bool:
        # Contact pushes the fingers apart, along their positive axes.
        pressed = contact[4:6].min() > self._parameters.grasp_force / 2
        return bool(pressed and hand[4] + hand[5] > self._parameters.minimum_width)


def _action_of(state: PlannerState) -> PickPlaceAction:
    """The last action begun, or the stop, without heights."""
    pick, place = (PlanarPose(*map(float, pose)) for pose in (state.pick, state.place))
    return PickPlaceAction(
        pick,
        place,
        stop=bool(state.stop),
        reason=list(STOP_REASONS)[int(state.stop) - 1] if state.stop else "",
        press=bool(state.press),
        aside=bool(state.aside),
    )


def _outcome(before: float, state: PlannerState) -> str:
    """How an action has ended, by the mode before `RETREAT`."""
    if state.stops:
        return "stopped"
    by_mode = {Mode.DESCEND: "pressed", Mode.CHECK: "missed", Mode.RELEASE: "placed"}
    return by_mode.get(Mode(int(before)), "dropped")
