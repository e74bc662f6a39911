"""Watches the contact force on the hand: weighs the payload, records peaks, enforces a limit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.grip_force import GRAVITY
from systems.pick_place_parameters import Mode
from systems.planner_state import RECENT, PlannerState

HEAVIEST = 3.0
"""Largest payload of a Franka arm, in kg. A stronger pull is not the weight of an object."""
_LASTING = 1 / 64
"""Peak forces are means over this time, in s. In modes that expect contact, the guard acts only if
a force above the limit lasts longer than this. An impact is shorter, a jam is longer."""
_WEIGHINGS = 16
"""The payload is averaged over about this many samples."""
_CLEAR = 0.001
"""The payload is weighed while the hand is at most this far below the travel height (see
`MotionHeights`), in m."""

_UNWEIGHED = (Mode.LIFT, Mode.CARRY)
"""The modes in which an object of unknown weight may be in the hand."""
_LETS_GO = (Mode.RELEASE, Mode.RETREAT)
_RISES = (Mode.LIFT, Mode.RETREAT)
_AT_ONCE = (Mode.APPROACH, Mode.CHECK, Mode.LIFT, Mode.CARRY)
"""The modes in which the guard acts at once, because the hand is in the air, at rest, or rises."""
_AT_REST = (Mode.OBSERVE, Mode.DONE)


def known_payload(state: PlannerState) -> float:
    """The vertical force of the held object on the hand, in N, negative downwards. It is the
    measured force until the object has been weighed, then the object's weight. It is zero in all
    modes except `LIFT`, `CARRY`, `LOWER` and `SEARCH`."""
    mode = Mode(int(state.mode))
    if mode in (Mode.LOWER, Mode.SEARCH):
        return state.payload
    if mode not in _UNWEIGHED:
        return 0.0
    return state.payload if state.weighings >= _WEIGHINGS / 2 else state.felt_payload


class ContactGuard:
    r"""Computes contact forces without the payload, and stops the hand if one exceeds a limit.

    Let f be the contact force on the hand, m the mass of the held object, a the commanded
    acceleration and g gravity. The contact force without the payload is

        vertical = f_z + m (g + a_z),    lateral = |f_xy + m a_xy|.

    - m is zero while the hand is empty.
    - In `LIFT`, and in `CARRY` until the object is weighed, m is the mass that makes the vertical
      force zero, limited to the range from 0 to `HEAVIEST`.
    - In `CARRY`, while the hand is above the travel height, the object is weighed: m is the mean of
      -f_z / (g + a_z). A contact further down therefore does not count as payload.
    - In `RELEASE` and `RETREAT` the jaws may or may not still hold the object, so any f_z between
      the object's weight and zero counts as no contact.

    The guard acts if the vertical or the lateral force exceeds the limit. In `APPROACH`, `CHECK`,
    `LIFT` and `CARRY`, where no impact is expected, it acts at once; in other modes, after 1/64 s.
    A push from below does not count while the hand rises. Vertical forces do not count while the
    hand presses an object down; then `press_force` is the limit.

    A peak is the largest mean over 1/64 s, as a wrist sensor would show it. In a shorter time the
    force of an impact is its impulse divided by the plant's step, and so depends on the step. The
    guard compares each sample with the limit, so a peak may be below the limit although it acted.
    """

    def __init__(self, limit: float, step: float) -> None:
        """
        Args:
            limit: the largest contact force, in N.
            step: the time between two calls of `feel`, in s.
        """
        self._limit, self._step = limit, step
        self._samples = min(max(round(_LASTING / step), 1), RECENT)

    def reset(self, state: PlannerState) -> None:
        """Clears the peaks and the payload of the last action."""
        state.payload = state.felt_payload = state.weighings = state.beyond = 0.0
        state.peak_vertical = state.peak_lateral = 0.0
        state.recent = np.zeros(3 * RECENT)
        state.peak_mode = state.mode

    def feel(
        self,
        state: PlannerState,
        contact: NDArray[np.float64],
        height: float,
        acceleration: NDArray[np.float64],
    ) -> bool:
        """Processes one sample of the contact force. Call it at every step, in all modes.

        Args:
            state: the planner's state; its payload and its peaks are updated.
            contact: (6) value of the port `hand_contact_force`.
            height: the height of the fingertips in the world, in m.
            acceleration: (3) commanded acceleration of the hand in the world, in m/s^2.

        Returns:
            Whether the hand must stop.
        """
        mode = Mode(int(state.mode))
        if mode in _AT_REST:
            return False
        f_x, f_y, f_z = contact[:3].tolist()
        a_x, a_y, a_z = acceleration.tolist()
        pull = max(GRAVITY + a_z, 1.0)
        if mode == Mode.CARRY:
            self._weigh(state, -f_z / pull, height)
        mass = self._mass(state, mode, -f_z / pull)
        if mode in _UNWEIGHED and not state.weighings:
            state.felt_payload = -GRAVITY * mass
        vertical = f_z + mass * pull
        if mode in _LETS_GO:
            vertical = f_z - min(max(f_z, -mass * pull), 0.0)
        side_x, side_y = f_x + mass * a_x, f_y + mass * a_y
        lateral = math.hypot(side_x, side_y)
        mean_x, mean_y, mean_z = self._mean(state, (side_x, side_y, vertical))
        self._keep_peaks(state, abs(mean_z), math.hypot(mean_x, mean_y))
        push = max(-vertical, 0.0) if mode in _RISES else abs(vertical)
        if mode == Mode.DESCEND and state.press:
            push = 0.0
        is_beyond = max(push, lateral) > self._limit
        state.beyond = state.beyond + self._step if is_beyond else 0.0
        return is_beyond and (mode in _AT_ONCE or state.beyond > _LASTING)

    def tare(self, state: PlannerState, contact: NDArray[np.float64], threshold: float) -> None:
        """Sets the payload to the vertical force at rest. If this force differs too much from the
        weighed payload, something else touches the hand or the object, and the payload stays as
        weighed.

        Args:
            state: the planner's state, at the end of `CARRY`.
            contact: (6) value of the port `hand_contact_force`.
            threshold: the vertical force that counts as contact, in N.
        """
        felt, weighed = float(contact[2]), float(state.payload)
        if not state.weighings or abs(felt - weighed) < threshold / 2 - 0.1 * weighed:
            state.payload = min(felt, 0.0)

    def _mean(self, state: PlannerState, latest: tuple[float, ...]) -> list[float]:
        """Adds the latest force to `recent`. Returns the mean (3) of the latest samples, in N."""
        # Use plain floats: this runs at every step, and NumPy is slower for so few elements.
        recent = state.recent
        kept = [*latest, *recent[: 3 * self._samples - 3].tolist()]
        recent[: len(kept)] = kept
        mean = [0.0, 0.0, 0.0]
        for index, component in enumerate(kept):
            mean[index % 3] += component / self._samples
        return mean

    def _weigh(self, state: PlannerState, apparent: float, height: float) -> None:
        if height >= state.travel_z - _CLEAR:
            state.weighings = min(state.weighings + 1, _WEIGHINGS)
            mass = min(max(apparent, 0.0), HEAVIEST)
            state.payload += (-GRAVITY * mass - state.payload) / state.weighings

    @staticmethod
    def _mass(state: PlannerState, mode: Mode, apparent: float) -> float:
        if mode in _UNWEIGHED and not state.weighings:
            return min(max(apparent, 0.0), HEAVIEST)
        holds = mode in (Mode.CARRY, Mode.LOWER, Mode.SEARCH, *_LETS_GO)
        return -state.payload / GRAVITY if holds else 0.0

    @staticmethod
    def _keep_peaks(state: PlannerState, vertical: float, lateral: float) -> None:
        if max(vertical, lateral) > max(state.peak_vertical, state.peak_lateral):
            state.peak_mode = state.mode
        state.peak_vertical = max(state.peak_vertical, vertical)
        state.peak_lateral = max(state.peak_lateral, lateral)
