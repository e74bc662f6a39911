"""The pick-and-place motion primitive: a state machine with smooth, limited motions."""

import dataclasses
import functools
import math

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.attempt_history import (
    AttemptHistory,
    LeftOverVector,
    known_point,
    known_spread,
)
from systems.contact_guard import ContactGuard, known_payload
from systems.floating_hand_motion import HandMotion
from systems.hand_geometry import check_reach
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.pick_place_steps import PickPlaceSteps
from systems.planner_state import Moment, PlannerState
from systems.robot_motion import RobotMotion
from systems.signals import (
    STOP_REASONS,
    Observation,
    PickPlaceAction,
    PlanarPose,
    SurfaceHeights,
)
from systems.surface_heights import read_surface_heights
from systems.weak_calc import weak_calc

_ASIDE = 0.05
"""An object to be laid aside is lowered slowly from this much higher, in m, because it may hang
aslant: it leaned on others or lay in a heap."""


class PickPlacePlanner(LeafSystem):
    """Executes one pick and place after another.

    .. pydrake_system::

        name: PickPlacePlanner
        input_ports:
        - hand_state
        - hand_contact_force
        - action
        - observation (optional)
        - wrist_moment (optional)
        output_ports:
        - desired_motion
        - desired_opening
        - closing_force
        - mode
        - counts
        - failed_picks
        - history
        - peak_force
        - payload
        - asks
        - accepted_action

    - `hand_state` (12): positions then velocities of (x, y, z, yaw, left finger, right finger).
    - `hand_contact_force` (6): the generalized contact force on the same coordinates, in N and N m,
      as force-torque sensors at the wrist and in each finger would measure it. A force upwards is
      positive.
    - `action` (abstract, `PickPlaceAction`): the next action. The port is evaluated only when the
      hand rests out of the cameras' sight and the planner needs an action. Policy and cameras are
      not evaluated at other times.
    - `observation` (abstract, `Observation`): o_t. If the action carries no surface heights, this
      port is evaluated together with it, and the heights are read off o_t.
    - `wrist_moment` (1): the moment of the contact forces about the hand's y axis, along which the
      jaws close, in N m, as a force-torque sensor at the wrist measures it while the hand moves
      vertically. It is positive for a load on the hand's +x side. It is evaluated in `LIFT` only.
    - `desired_motion` (12 or 21): positions q_d, velocities v_d and accelerations a_d of (x, y, z,
      yaw), or of an arm's seven joints, in m, rad and s.
    - `desired_opening` (2): the opening between the pads in m, and its rate in m/s.
    - `closing_force` (1): force of each pad in addition to the force that holds the opening, in N.
    - `mode` (1): a `Mode`.
    - `counts` (4): the numbers of actions begun, grasps missed, objects dropped, and actions
      stopped by the force guard.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): the last 16 picks whose action had another
      outcome than "placed" (see `OUTCOMES`), oldest first. A policy can use them to try another
      pick.
    - `history` (abstract, a tuple of `Attempt`): the last 64 actions with a known outcome, oldest
      first.
    - `peak_force` (3): the largest vertical and lateral contact force on the hand in the present or
      last action, without the weight of the held object, in N, as means over 1/64 s; then the
      `Mode` in which the larger of the two occurred. See `ContactGuard`.
    - `payload` (1): the vertical force of the object that the hand lifts, carries or lowers, in N:
      the measured force until the object has been weighed, then its weight. It is negative or zero.
    - `asks` (1): 1 if the planner's next update, at the context's time, will evaluate `action`;
      else 0.
    - `accepted_action` (abstract, `PickPlaceAction`): the action that began last, with the hand's
      actual yaws and without heights. After a stop it is the stopping action, with up to 24 objects
      and 24 cavities in its `left_over`.

    Motions are smooth and as short as the limits on speed and acceleration allow. For an arm see
    `ArmMotion`. A floating hand moves in straight lines in (x, y); height and yaw move
    independently (see `systems.hand_motion`). When its `CARRY` continues from an unfinished `LIFT`,
    only the velocity is continuous.

    - `LIFT`, `RETREAT`: the hand rises above the highest surface of o_t before it travels.
    - `APPROACH`, `CARRY`: near its goal, the hand sinks to just above the surfaces there.
    - `DESCEND`, `LOWER`: guarded motions, which stop at once when the vertical contact force
      exceeds the payload's weight by `contact_threshold`. The heights of table, kit and cavity need
      not be known exactly. Where o_t shows a surface, the hand slows down first, because the force
      of an impact is proportional to the speed.
    - `CHECK`: a grasp is good if the pads are further apart than `minimum_width` and both feel at
      least half of the grasp force. If the grasp is not good, or is lost later, the hand retreats
      and observes again. The attempt counts as an action. If the hand feels a lateral force at
      rest, the jaws grip something fixed, and let go.
    - `LIFT`, `CARRY`: the more the object weighs, and the larger the moment of its weight about the
      axis of the pads, the more firmly it is gripped (`grip_force`), but less firmly if the jaws
      sink in (`soft_force`). A heavy object is lifted only once the grip is firm. A floating hand
      moves it with less speed and acceleration (`gentleness`).
    - `LIFT`: if the object is heavy or its moment about the axis of the pads is notable, the hand
      lifts it by 1 cm first, and rests. If the object turns between the pads, or the moment is more
      than friction holds on the way (`slips_when_carried`), it is set down again. The history then
      contains the estimated centre of mass, so that a policy can grip the object there.
      An object that leaves the table late hangs lower than it lay, because it turned or another
      object is caught in it; it is lifted and carried higher by half as much again (`hanging`).
    - `LIFT`, `CARRY`: if the jaws suddenly close, the pads slip off the object. The hand then
      retreats with opening jaws, and the object counts as dropped.
    - `RELEASE`: if the jaws stick to the object, they open with force. If a force ended the
      action and something pushes the hand up, it rises by 5 mm as they open.
    - `RETREAT`: if an object still hangs on the hand as it rises, the hand brakes (`RELEASE`),
      lowers the object (`LOWER`) and moves its jaws (`RELEASE`), twice at most in an action.
    - `SEARCH`: in tasks that insert objects into cavities, if the object stands on the rim around
      its place, the hand searches for the cavity. When the resistance ends, it lowers the object
      further.
    - An action with `press` consists of `APPROACH` and `DESCEND` with closed jaws. They touch the
      object at `touch_speed` and press with up to `press_force`.
    - An action whose poses the robot cannot reach ends before anything moves, with the outcome
      "unreachable".
    - In all modes, a contact force beyond `force_limit` ends the action (see `ContactGuard`): the
      hand stops at once, lets go of the object, and retreats. The pick counts as failed.

    State (discrete): the `PlannerState`, the `AttemptHistory`, and the `LeftOver` of a policy that
    stopped.
    """

    def __init__(
        self,
        *,
        parameters: PickPlaceParameters,
        max_actions: int,
        motion: RobotMotion | None = None,
        insertion: bool = False,
        period: float = 1 / 64,
        force_period: float = 1 / 128,
    ) -> None:
        """
        Args:
            parameters: heights, speeds and thresholds.
            max_actions: stop after this many actions, unless `parameters.max_actions` overrides it.
                Actions that set the object down again, because it would turn in the jaws, do not
                count.
            motion: computes the motions; None stands for `HandMotion`.
            insertion: whether to search for a cavity when a place is blocked.
            period: update period of the state machine, in s.
            force_period: update period of the force guard and of the guarded motions, in s; use the
                plant's time step.
        """
        super().__init__()
        self._parameters = parameters
        given = parameters.max_actions
        self._max_actions = max_actions if given is None else given
        self._motion = motion or HandMotion(parameters)
        self._state_index = self.DeclareDiscreteState(self._motion.initial_state())
        self._history_index = self.DeclareDiscreteState(np.full(AttemptHistory.size, np.nan))
        self._left_over_index = self.DeclareDiscreteState(np.zeros(LeftOverVector.size))
        self._guard = ContactGuard(parameters.force_limit, force_period)
        search_steps = parameters.search.steps if insertion else 0
        self._steps = PickPlaceSteps(parameters, self._motion, self._guard, search_steps)
        self._period = period
        # Declare `_feel` first: Drake handles simultaneous events in the order of declaration.
        self.DeclarePeriodicDiscreteUpdateEvent(force_period, 0.0, self._feel)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

        self._hand_state = self.DeclareVectorInputPort("hand_state", 12)
        self._contact_force = self.DeclareVectorInputPort("hand_contact_force", 6)
        self._action = self.DeclareAbstractInputPort("action", Value(PickPlaceAction()))
        self._observation = self.DeclareAbstractInputPort("observation", Value(Observation()))
        self._wrist_moment = self.DeclareVectorInputPort("wrist_moment", 1)
        state_and_time = {self.discrete_state_ticket(self._state_index), self.time_ticket()}
        self._motion_port = self.DeclareVectorOutputPort(
            "desired_motion", self._motion.size, self._calc_motion, state_and_time
        )
        self.DeclareVectorOutputPort("desired_opening", 2, self._calc_opening, state_and_time)
        self.DeclareVectorOutputPort("closing_force", 1, self._calc_force, state_and_time)
        state_only = {self.discrete_state_ticket(self._state_index)}
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, state_only)
        self.DeclareVectorOutputPort("counts", 4, self._calc_counts, state_only)
        self.DeclareVectorOutputPort("peak_force", 3, self._calc_peak_force, state_only)
        self.DeclareVectorOutputPort("payload", 1, self._calc_payload, state_only)
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

    def mode(self, context: Context) -> Mode:
        """The present mode, in this system's context."""
        return Mode(int(self._state(context).mode))

    def _state(self, context: Context) -> PlannerState:
        return self._motion.view(context.get_discrete_state(self._state_index).get_value())

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

    def _calc_payload(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([known_payload(self._state(context))])

    def _calc_asks(self, context: Context, output: BasicVector) -> None:
        state, time = self._state(context), context.get_time()
        asks = (
            state.mode == Mode.OBSERVE
            and not self._has_spent(state)
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

    def _feel(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        moment = self._moment(context, discrete_state)
        state = moment.state
        if state.mode in (Mode.OBSERVE, Mode.DONE):
            return EventStatus.DidNothing()
        before = state.mode, state.stops, _peak(state)
        desired = self._motion_port.Eval(context)
        acceleration = self._motion.hand_acceleration(state, moment.time, desired)
        self._steps.feel(moment, acceleration)
        self._conclude(before[0], state, discrete_state)
        goes_on = before[0] == Mode.RETREAT or state.layings
        if goes_on and before[1:] != (state.stops, _peak(state)):
            history = AttemptHistory(discrete_state.get_mutable_value(self._history_index))
            history.amend("stopped" if state.stops else None, _peak(state))
        return EventStatus.Succeeded()

    def _moment(self, context: Context, discrete_state: DiscreteValues) -> Moment:
        state = self._motion.view(discrete_state.get_mutable_value(self._state_index))
        feels = state.mode == Mode.LIFT and self._wrist_moment.HasValue(context)
        return Moment(
            state,
            context.get_time(),
            self._hand_state.Eval(context),
            self._contact_force.Eval(context),
            float(self._wrist_moment.Eval(context)[0]) if feels else None,
        )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        moment = self._moment(context, discrete_state)
        state, mode = moment.state, moment.state.mode
        if mode == Mode.OBSERVE:
            self._observe(context, state, discrete_state)
        elif mode != Mode.DONE:
            self._steps.step(moment)
            self._conclude(mode, state, discrete_state)
        return EventStatus.Succeeded()

    def _conclude(self, before: float, state: PlannerState, discrete_state: DiscreteValues) -> None:
        """Writes the present action into the history when the hand begins to retreat."""
        if state.mode == Mode.RETREAT and before != Mode.RETREAT and not state.layings:
            history = AttemptHistory(discrete_state.get_mutable_value(self._history_index))
            outcome = _outcome(before, state)
            balance = _balance(state) if outcome == "set down" else None
            top = _top(state) if outcome == "placed" else None
            # An object that is set down after a trial lift has replaced the floor's height.
            replaced = state.doubts_grip and before != Mode.LIFT
            floor = None if state.press or replaced else float(state.floor_z)
            history.append(_action_of(state), outcome, _peak(state), balance, top, floor)
            state.free_actions += outcome == "set down"

    def _observe(
        self, context: Context, state: PlannerState, discrete_state: DiscreteValues
    ) -> None:
        time = context.get_time()
        if not self._has_settled(state, time):
            return
        stop = PickPlaceAction(stop=True, reason="actions spent")
        action: PickPlaceAction = stop if self._has_spent(state) else self._action.Eval(context)
        if action.stop:
            state.stop = 1 + list(STOP_REASONS).index(action.reason or "done")
            kept = discrete_state.get_mutable_value(self._left_over_index)
            LeftOverVector(kept).write(action.left_over)
            self._motion.begin(state, Mode.DONE, time)
            return
        check_reach(action)
        if action.press:
            action = dataclasses.replace(action, place=action.pick)
        self._set_heights(state, self._heights(context, action))
        if action.aside:
            hover = float(state.place_hover_z)
            state.place_hover_z = max(hover, min(hover + _ASIDE, float(state.travel_z)))
        state.search_step, state.press, state.aside = 0, action.press, action.aside
        state.middle = np.nan if action.middle is None else action.middle
        state.spread = np.nan if action.spread is None else action.spread
        state.stops = state.doubts_grip = state.layings = state.lowers_next = 0
        kept = AttemptHistory(discrete_state.get_mutable_value(self._history_index))
        state.set_downs = kept.set_downs(action.pick)
        state.actions += 1
        self._guard.reset(state)
        state.pick, state.place = action.pick.as_array(), action.place.as_array()
        state.refused = not self._motion.prepare(state)
        self._motion.begin(state, Mode.APPROACH, time)

    def _has_spent(self, state: PlannerState) -> bool:
        """Whether the limit of actions is reached. Actions that set the object down where it lay do
        not count."""
        return bool(state.actions - state.free_actions >= self._max_actions)

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
        state.set_heights(motion_heights(heights, self._parameters), heights)


def _action_of(state: PlannerState) -> PickPlaceAction:
    """Returns the action that began last; after a stop, the stopping action. Its heights are not
    set."""
    pick, place = (PlanarPose(*map(float, pose)) for pose in (state.pick, state.place))
    return PickPlaceAction(
        pick,
        place,
        stop=bool(state.stop),
        reason=list(STOP_REASONS)[int(state.stop) - 1] if state.stop else "",
        press=bool(state.press),
        aside=bool(state.aside),
        middle=known_point(state.middle),
        spread=known_spread(state.spread),
    )


def _outcome(before: float, state: PlannerState) -> str:
    """The outcome of an action, one of `OUTCOMES`. `before` is the mode before `RETREAT`."""
    if state.refused:
        return "unreachable"
    if state.stops:
        return "stopped"
    if state.doubts_grip and before == Mode.RELEASE:
        return "set down"
    # An object that is lost in a search lies at its place.
    by_mode = {
        Mode.DESCEND: "pressed",
        Mode.CHECK: "missed",
        Mode.SEARCH: "placed",
        Mode.RELEASE: "placed",
    }
    return by_mode.get(Mode(int(before)), "dropped")


def _balance(state: PlannerState) -> tuple[float, float]:
    """(x, y) of the object's centre of mass in the world, in m, as estimated from the wrist's
    moment."""
    x, y, yaw = state.pick.tolist()
    return x + state.lever * math.cos(yaw), y + state.lever * math.sin(yaw)


def _top(state: PlannerState) -> float:
    """The height of the object's top at the place if it stands on the floor there, in m."""
    return float(state.floor_z + state.pick_top_z - state.support_z)


def _peak(state: PlannerState) -> float:
    return max(state.peak_vertical, state.peak_lateral)
