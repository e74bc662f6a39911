"""The state machine of one pick and place, from the beginning of an action to its end."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.contact_guard import ContactGuard
from systems.grip_force import (
    felt_lever,
    felt_weight,
    gentleness,
    grip_force,
    lifts_too_early,
    may_turn,
    moment_at_rest,
    slips_when_carried,
    soft_force,
    turns_in_the_pads,
)
from systems.hanging import begin_lift, feel_weight, lift_higher
from systems.letting_go import STUCK, LettingGo
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import Moment, PlannerState, Z
from systems.robot_motion import RobotMotion

_HOLDING = (Mode.CHECK, Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.SEARCH, Mode.RELEASE)
"""The modes in which an object may be in the hand."""
_STEADY = 0.6
"""An object has turned if its lever (see `felt_lever`) falls below this fraction of its earlier
value."""
_STALLED = 0.1
"""The jaws have stalled when they close at less than this share of the commanded speed. Soft pads
still yield more slowly than that while the force builds up."""
_STILL, _LONGEST_CHECK = 0.002, 0.4
"""The grip is checked once the jaws move more slowly than this, in m/s, or after this time, in s:
an object that leans or lies askew yields for a while."""
_FIXED = 20.0
"""If the closed jaws feel a lateral force above this at rest, in N, they grip something fixed."""
_SLIPS = 0.1
"""If the jaws close faster than this while they hold an object, in m/s, the pads slip off it."""
_YIELDS = 0.005
"""A hand that is pushed up while it should let go rises by this distance, in m."""
_LEAST_SINK = 0.001
"""There is no search for a cavity into which the object could sink by less than this, in m."""
_RISES = 0.02
"""The hand counts as rising if its vertical speed is above this, in m/s."""
_RISEN = 0.0005
"""The hand counts as lifted when it is this far, in m, above its height at the grip."""


class PickPlaceSteps:
    """Executes the modes from `APPROACH` to `RETREAT`, as `PickPlacePlanner` documents them."""

    def __init__(
        self,
        parameters: PickPlaceParameters,
        motion: RobotMotion,
        guard: ContactGuard,
        search_steps: int,
    ) -> None:
        """
        Args:
            parameters: heights, speeds and thresholds.
            motion: begins the motion of a mode.
            guard: watches the contact force and weighs the payload.
            search_steps: number of offsets to try when an insertion is blocked.
        """
        self._parameters, self._motion, self._guard = parameters, motion, guard
        self._search_steps = search_steps
        self._settle = min(parameters.tare_settle, motion.settles)
        self._letting_go = LettingGo(parameters, motion, self._settle)
        self._steps = {
            Mode.DESCEND: self.descend,
            Mode.CLOSE: self.close,
            Mode.CHECK: self.check,
            Mode.LIFT: self.lift,
            Mode.CARRY: self.hold,
            Mode.LOWER: self.lower,
            Mode.SEARCH: self.search,
            Mode.RELEASE: self.release,
        }

    def step(self, moment: Moment) -> None:
        """Executes one step of the present mode."""
        self._steps.get(Mode(int(moment.state.mode)), self.follow)(moment)

    def feel(self, moment: Moment, acceleration: NDArray[np.float64]) -> None:
        """Watches the contact force. Call it at every step of the plant.

        The steps of `DESCEND` and `LOWER` are executed here as well, so that these motions stop
        soon after a contact. In `RETREAT` the hand feels whether it still carries an object.

        Args:
            moment: the inputs.
            acceleration: (3) commanded acceleration of the hand in the world, in m/s^2.
        """
        state, hand = moment.state, moment.hand
        if state.mode != Mode.RETREAT:
            state.let_go_z, state.carries_since = hand[2], np.inf
        must_stop = self._guard.feel(state, moment.contact, float(hand[2]), acceleration)
        if must_stop and not state.stops:
            self.stop(moment)
        elif state.mode in (Mode.DESCEND, Mode.LOWER):
            self.step(moment)
        elif state.mode == Mode.RETREAT:
            self._letting_go.feel_load(moment)

    def stop(self, moment: Moment) -> None:
        """Stops the hand at once, lets go of the object in it, and retreats."""
        state = moment.state
        state.stopped, state.stops = state.stopped + 1, 1
        state.lowers_next = 0
        retreats, holds = state.mode == Mode.RETREAT, state.mode in _HOLDING
        following = Mode.RELEASE if holds else Mode.RETREAT
        self._motion.begin(state, following, moment.time, at=moment.hand[:4])
        if holds and state.recent[Z] > self._parameters.contact_threshold:
            # The jaws may be wedged under an object, or it may tip up as they open.
            self._motion.back_off(state, _YIELDS)
        if retreats:
            # A force during the retreat means that the jaws drag something: open them fully.
            state.goal_opening = self._parameters.open_width

    def follow(self, moment: Moment) -> None:
        """Begins the next mode when the motion of the present mode is complete."""
        state, time = moment.state, moment.time
        if time >= self._motion.arrival(state):
            following = Mode.OBSERVE if state.mode == Mode.RETREAT else Mode(int(state.mode) + 1)
            if state.mode == Mode.APPROACH and state.refused:
                following = Mode.RETREAT
            self._motion.begin(state, following, time)

    def descend(self, moment: Moment) -> None:
        """Moves down until contact. An action that presses goes on until the force reaches
        `press_stop_force`."""
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if state.press:
            if contact[2] > self._parameters.press_stop_force:
                # Stop at once: during braking the hand would press harder.
                self._motion.begin(state, Mode.RETREAT, time, z=hand[2])
            elif time >= self._motion.arrival(state):
                self._motion.begin(state, Mode.RETREAT, time)
        elif contact[2] > self._parameters.contact_threshold:
            self._motion.begin(state, Mode.CLOSE, time, z=hand[2])
            # Rise a little: the jaws cannot close while the fingertips press on a surface.
            self._motion.back_off(state, self._parameters.floor_clearance)
        elif time >= self._motion.arrival(state):
            self._motion.begin(state, Mode.CLOSE, time)

    def close(self, moment: Moment) -> None:
        """Closes the jaws until they stall, then squeezes."""
        state, time, hand = moment.state, moment.time, moment.hand
        opening, rate = hand[4] + hand[5], hand[10] + hand[11]
        moving_for = time - state.start_time
        # Stalled jaws lag behind their command by the force divided by the stiffness of the
        # fingers' control.
        commanded, _ = self._motion.opening_at(state, time)
        slow = abs(rate) < _STALLED * 2 * self._parameters.finger_speed
        stalled = moving_for > 0.1 and slow and commanded < opening - 1e-3
        if stalled or commanded <= 0.0:
            self._motion.begin(state, Mode.CHECK, time, opening=opening)

    def check(self, moment: Moment) -> None:
        """Begins the lift if a loose object is between the pads, else lets go and retreats."""
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if time < self._motion.arrival(state) + self._settle:
            return
        if abs(hand[10] + hand[11]) > _STILL and time < state.start_time + _LONGEST_CHECK:
            return
        is_held = self._is_held(hand, contact)
        if is_held and math.hypot(*contact[:2]) > _FIXED:
            # The jaws grip the wall of a kit, or press the object against it.
            self.stop(moment)
        elif is_held:
            state.hold_z, state.held_width = hand[2], hand[4] + hand[5]
            state.gentleness = state.trusts_grip = 0
            begin_lift(state, float(hand[2]))
            # If the object is gripped higher than planned, it hangs lower below the fingertips.
            higher = max(hand[2] - state.grasp_z, 0.0)
            state.travel_z += higher
            state.place_hover_z += higher
            self._motion.begin(state, Mode.LIFT, time)
        else:
            state.missed += 1
            self._motion.begin(state, Mode.RETREAT, time)

    def lift(self, moment: Moment) -> None:
        """Lifts the object. Sets it down again if it would turn between the pads."""
        state, time = moment.state, moment.time
        if self._slips(moment.hand):
            self._lose(moment)
            return
        desired = self._motion.motion_at(state, time)
        acceleration = float(self._motion.hand_acceleration(state, time, desired)[Z])
        weight = felt_weight(moment.contact[2], acceleration)
        feel_weight(state, weight, float(moment.hand[2]))
        turning = moment.wrist_moment or 0.0
        at_rest = moment_at_rest(turning, acceleration)
        share = gentleness(weight, at_rest, float(state.gentleness), self._parameters)
        if share < (state.gentleness or 1.0):
            self._motion.slow_down(state, time, share)
        if state.doubts_grip:
            self._grip(moment, weight, at_rest)
            lever = felt_lever(turning, weight)
            if acceleration <= 0 and weight > state.trial_weight:
                state.lever, state.trial_weight = lever, weight
            if time >= self._motion.arrival(state) + self._parameters.tare_settle:
                self._end_trial(moment, lever, weight)
        elif moment.hand[2] > state.hold_z + _RISEN and self._doubts_grip(moment, weight, at_rest):
            state.doubts_grip, state.lever, state.trial_weight = 1, 0.0, 0.0
            self._grip(moment, weight, at_rest)
            self._motion.begin(state, Mode.LIFT, time)
        else:
            self.hold(moment)

    def _doubts_grip(self, moment: Moment, weight: float, turning: float) -> bool:
        """Whether a trial lift must first show how the object hangs."""
        state = moment.state
        if moment.wrist_moment is None or state.trusts_grip:
            return False
        is_heavy = weight > self._parameters.heavy_load
        turns = turns_in_the_pads(turning, float(state.set_downs))
        return is_heavy or turns or may_turn(turning)

    def _end_trial(self, moment: Moment, lever: float, weight: float) -> None:
        """Ends a trial lift: sets the object down if it has turned or may turn on the way, else
        continues to lift.

        Args:
            moment: the inputs, after the hand has rested.
            lever: the result of `felt_lever` at this moment, in m.
            weight: the object's weight, in N.
        """
        state = moment.state
        # As an object turns, its centre of mass swings down, and its lever becomes shorter.
        before = float(state.lever)
        has_turned = lever * before < _STEADY * before**2
        if has_turned:
            lever, weight = before, float(state.trial_weight)
        # The allowed moment grows with the number of earlier attempts, but not for an object that
        # has turned.
        turning, times = lever * weight, float(state.set_downs)
        if may_turn(turning) if has_turned else slips_when_carried(turning, times):
            state.lever = lever
            self._set_down(moment)
        else:
            state.doubts_grip, state.trusts_grip = 0, 1
            self._motion.begin(state, Mode.LIFT, moment.time)

    def _set_down(self, moment: Moment) -> None:
        """Begins to lower the object to where it was picked."""
        state = moment.state
        self._guard.tare(state, moment.contact, self._parameters.contact_threshold)
        # The object may touch the table at any height, so move slowly and let go at the first
        # contact.
        state.floor_z, state.rim_z = state.travel_z, state.table_z
        self._motion.begin(state, Mode.LOWER, moment.time)

    def hold(self, moment: Moment) -> None:
        """Lifts and carries the object while it is held, and adapts the grip force."""
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        desired = self._motion.motion_at(state, time)
        acceleration = self._motion.hand_acceleration(state, time, desired)
        weight = felt_weight(contact[2], acceleration[Z])
        force = self._grip(
            moment, weight, moment_at_rest(moment.wrist_moment or 0.0, acceleration[Z])
        )
        if state.mode == Mode.LIFT and lifts_too_early(force, self._motion.force_at(state, time)):
            # Brake, and continue when the grip is firm.
            self._motion.begin(state, Mode.LIFT, time)
        if self._slips(hand) or not self._is_held(hand, contact):
            self._lose(moment)
        elif state.mode == Mode.LIFT:
            if self._motion.brakes_above(state, time, state.travel_z):
                # An object that hangs lower than planned must first rise by as much.
                following = Mode.LIFT if lift_higher(state) else Mode.CARRY
                self._motion.begin(state, following, time)
        elif self._hangs_lower(moment, weight):
            self._motion.begin(state, Mode.LIFT, time)
        elif time >= self._motion.arrival(state) + self._settle:
            self._guard.tare(state, contact, self._parameters.contact_threshold)
            self._motion.begin(state, Mode.LOWER, time)

    def _lose(self, moment: Moment) -> None:
        """Retreats without the object, which was lost.

        Jaws that have closed stay closed: if they opened inside a ring, they would lift it. A hand
        that sinks stops at once, because the object lies under it.
        """
        state, hand, opening = moment.state, moment.hand, float(moment.hand[4] + moment.hand[5])
        state.dropped += 1
        kept = max(opening, 0.0) if opening < STUCK else None
        at = hand[:4] if hand[8] < 0 else None
        self._motion.begin(state, Mode.RETREAT, moment.time, opening=kept, at=at)

    def _hangs_lower(self, moment: Moment, weight: float) -> bool:
        """Whether the object proves to hang lower while the hand, in `CARRY`, still rises."""
        if moment.hand[8] < _RISES:
            return False
        feel_weight(moment.state, weight, float(moment.hand[2]))
        return lift_higher(moment.state)

    def _grip(self, moment: Moment, weight: float, turning: float) -> float:
        """Adapts the grip force to the object.

        Args:
            moment: the inputs.
            weight: the weight that the hand feels, in N.
            turning: the moment about the axis of the pads while the hand rests, in N m.

        Returns:
            The force of each pad after its ramp, in N.
        """
        state, hand, parameters = moment.state, moment.hand, self._parameters
        present = float(state.goal_force)
        force = grip_force(weight, present, parameters, turning)
        width = float(state.held_width)
        force = soft_force(force, width - hand[4] - hand[5], width, present, parameters)
        self._motion.set_force(state, moment.time, force)
        return force

    def lower(self, moment: Moment) -> None:
        """Lowers the object until contact. Begins the search if it then stands on a rim."""
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        if state.layings:
            touches = state.recent[Z] > self._parameters.contact_threshold
            if touches or time >= self._motion.arrival(state):
                self._letting_go.lay_down(moment)
        elif not self._is_held(hand, contact):
            self._lose(moment)
        elif state.recent[Z] > self._parameters.contact_threshold:
            if self._is_blocked(state, hand):
                state.touch_z = hand[2]
                self._motion.begin(state, Mode.SEARCH, time, z=hand[2])
            else:
                self._motion.begin(state, Mode.RELEASE, time, z=hand[2])
        elif time >= self._motion.arrival(state):
            self._motion.begin(state, Mode.RELEASE, time)

    def search(self, moment: Moment) -> None:
        """Tries one offset after the other until the object slips in."""
        state, time, hand, contact = moment.state, moment.time, moment.hand, moment.contact
        free = state.recent[Z] < self._parameters.contact_threshold / 2
        if not self._is_held(hand, contact):
            self._lose(moment)
        elif free and self._parameters.search.has_slipped_in(hand[2], state.touch_z):
            # The object has found its cavity: stop here without braking, and lower it.
            self._motion.begin(state, Mode.LOWER, time, z=hand[2])
        elif time >= self._motion.arrival(state):
            state.search_step += 1
            if state.search_step < self._search_steps:
                self._motion.begin(state, Mode.SEARCH, time)
            else:
                self._motion.begin(state, Mode.RELEASE, time, z=hand[2])

    def release(self, moment: Moment) -> None:
        """Opens the jaws, and goes on when they have opened."""
        if self._letting_go.release(moment):
            self.follow(moment)

    def _is_blocked(self, state: PlannerState, hand: NDArray[np.float64]) -> bool:
        """Whether the object stands on the rim of a cavity, and can sink in before the fingertips
        touch the rim."""
        bottom = hand[2] - state.hold_z + state.support_z
        left = state.search_step < self._search_steps
        search, rim, table = self._parameters.search, float(state.rim_z), float(state.table_z)
        doubt = float(state.doubt)
        has_room = hand[2] > rim + doubt + max(_LEAST_SINK, doubt)
        return bool(left and has_room and search.is_on_rim(float(bottom), rim, table))

    @staticmethod
    def _slips(hand: NDArray[np.float64]) -> bool:
        """Whether the jaws suddenly close."""
        return bool(hand[10] + hand[11] < -_SLIPS)

    def _is_held(self, hand: NDArray[np.float64], contact: NDArray[np.float64]) -> bool:
        # A held object pushes the fingers apart, along their positive axes.
        pressed = contact[4:6].min() > self._parameters.grasp_force / 2
        return bool(pressed and hand[4] + hand[5] > self._parameters.minimum_width)
