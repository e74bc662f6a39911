"""Lets go of the object in the hand, and notices if it still hangs on the hand."""

from __future__ import annotations

import numpy as np

from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import Moment
from systems.robot_motion import RobotMotion

_CARRIED = 0.5
"""If something pulls the rising hand down with more than this, in N, the hand still carries an
object."""
_FELT_FOR = 1 / 32
"""The pull must last for this time, in s."""
_LEAST_RISE, _MOST_RISE = 0.02, 0.15
"""The pull counts if the hand has risen by more than the first length, in m, because below it the
hand may brush against the object. The hand goes down again if it has risen by less than the
second."""
_MOST_LAYINGS = 2
"""How often the hand goes down again to rid itself of an object."""
STUCK = 0.004
"""If the opening of the jaws stays below its goal by more than this, in m, they stick to the
object."""
_PUSH = 1 / 3
"""The force that pushes sticking jaws open, as a share of the grasp force. It is added to the force
with which the jaws follow their command."""
_LONGEST_RELEASE = 1.0
"""After this time, in s, the hand rises even if the jaws stick."""


class LettingGo:
    """The steps of `RELEASE`, and of laying down an object that still hangs on the hand."""

    def __init__(self, parameters: PickPlaceParameters, motion: RobotMotion, settle: float) -> None:
        """
        Args:
            parameters: widths, forces and distances.
            motion: begins the motion of a mode.
            settle: the time for which the hand rests before it goes down again, in s.
        """
        self._parameters, self._motion, self._settle = parameters, motion, settle

    def release(self, moment: Moment) -> bool:
        """Opens the jaws, with force if they stick.

        Returns:
            Whether the mode ends when its motion is complete.
        """
        state, time, hand = moment.state, moment.time, moment.hand
        opening = hand[4] + hand[5]
        if state.lowers_next:
            if time >= self._motion.arrival(state) + self._settle:
                self._lower_again(moment)
        elif state.layings > 1:
            # Jaws that close must not clamp what is between them.
            if time >= self._motion.arrival(state):
                kept = max(float(opening), float(state.goal_opening))
                self._motion.begin(state, Mode.RETREAT, time, opening=kept)
        elif opening >= state.goal_opening - STUCK or time < self._motion.arrival(state):
            return True
        elif time < state.start_time + _LONGEST_RELEASE:
            self._motion.set_force(state, time, -_PUSH * self._parameters.grasp_force)
        else:
            # The fingers may be jammed in a cavity: do not press against its walls on the way up.
            self._motion.begin(state, Mode.RETREAT, time, opening=opening)
        return False

    def feel_load(self, moment: Moment) -> None:
        """Goes down again if an object that should have been let go still hangs on the hand."""
        state, time = moment.state, moment.time
        risen = moment.hand[2] - state.let_go_z
        if moment.contact[2] > -_CARRIED or risen < _LEAST_RISE:
            state.carries_since = np.inf
            return
        state.carries_since = min(float(state.carries_since), time)
        lasts = time - state.carries_since >= _FELT_FOR and risen < _MOST_RISE
        if lasts and state.layings < _MOST_LAYINGS and not state.stops and not state.press:
            state.layings += 1
            # Brake first.
            state.lowers_next = 1
            self._motion.begin(state, Mode.RELEASE, time)
            state.goal_opening = state.start_opening

    def _lower_again(self, moment: Moment) -> None:
        """Begins to lower an object that hangs on the resting hand. It hangs by an unknown length,
        so the hand moves slowly and stops at the first contact."""
        state = moment.state
        state.lowers_next = 0
        state.payload = min(float(moment.contact[2]), 0.0)
        state.floor_z, state.rim_z = state.travel_z, state.table_z
        state.place_hover_z = float(moment.hand[2]) + self._parameters.hover_clearance
        self._motion.begin(state, Mode.LOWER, moment.time)

    def lay_down(self, moment: Moment) -> None:
        """Lets go of an object that hung on the hand, after it was lowered again.

        The jaws open fully. The second time they close half of the way instead, because a finger
        may be wedged between two parts of the object.
        """
        state, opening = moment.state, float(moment.hand[4] + moment.hand[5])
        self._motion.begin(state, Mode.RELEASE, moment.time, opening=opening)
        first = state.layings == 1
        state.goal_opening = self._parameters.open_width if first else opening / 2
