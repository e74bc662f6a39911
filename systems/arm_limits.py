"""Limits of the joints of Franka arms, as their maker publishes them, and the use of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

JOINTS = 7
_ROUNDOFF = 1e-6

_Seven = tuple[float, float, float, float, float, float, float]


def _all(value: float) -> _Seven:
    return (value,) * 7


@dataclass(frozen=True)
class VelocityEnvelope:
    """Velocity limits that fall towards the ends of a joint's range.

    A joint at q may move towards the end q_max no faster than

        max(0, sqrt(2 d (q_max - q)) - offset),

    and the same limit holds for a motion towards q_min.
    """

    lower: _Seven
    """q_min of the class's formula: the lower end of each joint's range, in rad."""
    upper: _Seven
    """q_max of the class's formula: the upper end of each joint's range, in rad."""
    offset: _Seven
    """The offset that the class's formula subtracts for each joint, in rad/s."""
    deceleration: _Seven
    """The deceleration d of each joint, in rad/s^2."""


@dataclass(frozen=True)
class ArmLimits:
    """Limits of the seven joints, base to flange, in SI units."""

    lower: _Seven
    upper: _Seven
    velocity: _Seven
    acceleration: _Seven
    jerk: _Seven
    torque: _Seven
    torque_rate: _Seven
    envelope: VelocityEnvelope | None = None
    """The velocity limits that depend on the position; None if there are none."""

    def velocity_bounds(
        self, q: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lowest and the highest allowed velocities (..., 7), in rad/s, at joint positions
        (..., 7)."""
        high = np.broadcast_to(np.array(self.velocity), np.shape(q))
        if self.envelope is None:
            return -high, high
        ends = self.envelope
        offset, twice = np.array(ends.offset), 2 * np.array(ends.deceleration)
        to_upper = np.sqrt(np.maximum(twice * (ends.upper - q), 0.0)) - offset
        to_lower = np.sqrt(np.maximum(twice * (q - ends.lower), 0.0)) - offset
        return -np.clip(to_lower, 0.0, high), np.clip(to_upper, 0.0, high)


PANDA = ArmLimits(
    lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    torque=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
    torque_rate=_all(1000.0),
)
"""Franka Emika Robot (Panda). Source: Franka's FCI documentation, "Robot and interface
specifications", section "Limits for Panda"; accelerations and jerks also in libfranka 0.9,
`rate_limiting.h`."""

FR3 = ArmLimits(
    lower=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
    upper=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
    velocity=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    acceleration=_all(10.0),
    jerk=_all(5000.0),
    torque=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
    torque_rate=_all(1000.0),
    envelope=VelocityEnvelope(
        lower=(-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196),
        upper=(2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196),
        offset=(0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35),
        deceleration=(6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0),
    ),
)
"""Franka Research 3. Source: Franka's FCI documentation, "Robot and interface specifications",
section "Limits for Franka Research 3". libfranka 0.13 (`rate_limiting.h`) and franka_description
(`robots/fr3/joint_limits.yaml`) give the same numbers."""

ARM_LIMITS = {"fr3": FR3, "panda": PANDA}
"""The limits of each arm, by the name of its model."""


def limits_used(
    samples: NDArray[np.float64], limits: ArmLimits, rate: float
) -> tuple[tuple[str, float], ...]:
    """For each kind of limit, its name and the largest fraction of it that a motion uses.

    Args:
        samples: (n, 21) joint positions, velocities and accelerations at a constant rate, in rad
            and s.
        limits: limits of the joints; those of the velocities may depend on the positions.
        rate: rate of the samples, in Hz. At rates below 1 kHz the jerk is underestimated.
    """
    q, v, a = np.split(samples, 3, axis=1)
    lower, upper = np.array(limits.lower), np.array(limits.upper)
    position = np.abs(2 * (q - lower) / (upper - lower) - 1)
    low, high = limits.velocity_bounds(q)
    # Avoid 0 / 0 at the end of a joint's range, where the limit of velocity is zero.
    velocity = np.where(v > 0, v, -v) / np.maximum(np.where(v > 0, high, -low), 1e-9)
    jerk = np.abs(np.diff(a, axis=0)) * rate / limits.jerk
    shares = {
        "position": position,
        "velocity": velocity,
        "acceleration": np.abs(a) / limits.acceleration,
        "jerk": jerk,
    }
    return tuple((name, _share(values)) for name, values in shares.items())


def _share(values: NDArray[np.float64]) -> float:
    largest = float(values.max(initial=0.0))
    return 1.0 if 1.0 < largest < 1.0 + _ROUNDOFF else largest
