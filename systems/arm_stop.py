"""Plans the fastest stop of a Franka arm."""

from __future__ import annotations

import bisect
import itertools

import numpy as np
import ruckig
from numpy.typing import NDArray

from systems.arm_inertia import ArmInertia
from systems.arm_limits import JOINTS, ArmLimits

_SHARE = 0.98
"""Fraction of the limits of acceleration and jerk that a stop uses."""
_TRIES = 4
"""The jerk is reduced until no torque's rate exceeds its limit. This is the largest number of
attempts."""
_RESTS = 1e-9
"""Below this velocity in rad/s and this acceleration in rad/s^2 the arm counts as at rest."""


class ArmStop:
    """Brings all joints to rest with Ruckig. The joints brake along the direction in which they
    move.

    The jerk is piecewise constant.
    """

    def __init__(
        self,
        q: NDArray[np.float64],
        v: NDArray[np.float64],
        a: NDArray[np.float64],
        limits: ArmLimits,
        inertia: ArmInertia | None = None,
    ) -> None:
        """
        Args:
            q: (7) joint positions at the beginning, in rad.
            v: (7) joint velocities at the beginning, in rad/s.
            a: (7) joint accelerations at the beginning, in rad/s^2.
            limits: limits of the joints; only those of acceleration, jerk and torque rate are used.
            inertia: model of the arm's inertia; if None, torque rates are not limited.
        """
        self.goal, self.duration = q, 0.0
        """The positions (7), in rad, in which the joints come to rest, and how long that takes, in
        s."""
        if np.abs(v).max() < _RESTS and np.abs(a).max() < _RESTS:
            return
        jerk = _SHARE * np.array(limits.jerk)
        for _ in range(_TRIES):
            self._tabulate(_calculate(q, v, a, limits, jerk))
            if inertia is None:
                break
            excess = float((self._torque_rates(inertia) / limits.torque_rate).max()) / _SHARE
            if excess <= 1.0:
                break
            jerk = np.maximum(jerk / (1.02 * excess), 1.0)

    def _torque_rates(self, inertia: ArmInertia) -> NDArray[np.float64]:
        """(n, 7) largest rates of the joint torques M a, in N m/s, one row for each interval of
        constant jerk j. The rates are M j + M' a."""
        lasts = np.diff(self._times)[:, None]
        q, _, a = np.moveaxis(self._states, 1, 0)
        jerk = np.diff(a, axis=0) / lasts
        mass = np.array([inertia.mass(point) for point in q])
        change = np.diff(mass, axis=0) / lasts[..., None]
        ends = [
            np.einsum("nij,nj->ni", mass[at], jerk) + np.einsum("nij,nj->ni", change, a[at])
            for at in (slice(None, -1), slice(1, None))
        ]
        return np.maximum(*np.abs(ends))

    def _tabulate(self, found: ruckig.Trajectory) -> None:
        # Keep only plain numbers: Ruckig's objects report errors if they still exist when Python
        # exits.
        self.duration = found.duration
        switches = {0.0, found.duration}
        for profile in found.profiles[0]:
            steps = [*profile.brake.t, *profile.t]
            switches.update(np.clip(np.cumsum(steps), 0.0, found.duration).tolist())
        times = sorted(switches)
        self._times = [t for t, u in itertools.pairwise(times) if u - t > 1e-9]
        self._times.append(found.duration)
        self._states = np.array([found.at_time(time) for time in self._times])
        self.goal = self._states[-1, 0].copy()

    def at(self, time: float) -> NDArray[np.float64]:
        """Returns (21) joint positions, velocities and accelerations, in rad and s. The time, in s
        since the beginning, must be before the end."""
        index = min(max(bisect.bisect_right(self._times, time) - 1, 0), len(self._times) - 2)
        h, lasts = time - self._times[index], self._times[index + 1] - self._times[index]
        q, v, a = self._states[index]
        jerk = (self._states[index + 1, 2] - a) / lasts
        return np.concatenate(
            [
                q + h * (v + h * (a / 2 + h / 6 * jerk)),
                v + h * (a + h / 2 * jerk),
                a + h * jerk,
            ]
        )


def _calculate(
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    a: NDArray[np.float64],
    limits: ArmLimits,
    jerk: NDArray[np.float64],
) -> ruckig.Trajectory:
    given = ruckig.InputParameter(JOINTS)
    given.control_interface = ruckig.ControlInterface.Velocity
    given.synchronization = ruckig.Synchronization.Phase
    given.current_position, given.current_velocity = q.tolist(), v.tolist()
    given.current_acceleration = a.tolist()
    given.target_velocity = given.target_acceleration = [0.0] * JOINTS
    given.max_acceleration = [_SHARE * limit for limit in limits.acceleration]
    given.max_jerk = jerk.tolist()
    trajectory = ruckig.Trajectory(JOINTS)
    result = ruckig.Ruckig(JOINTS).calculate(given, trajectory)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RuntimeError(f"Ruckig found no motion that stops the arm: {result}")
    return trajectory
