"""The variants of a scenario's `robot:`.

Drake's YAML loader needs evaluated annotations, hence no `from __future__ import annotations`.
"""

import math
from dataclasses import dataclass

import numpy as np

from kitting_drake.tasks.task import TABLE
from systems.arm_kinematics import ArmBase
from systems.arm_limits import ARM_LIMITS
from systems.bounds import bounded
from systems.signals import PixelGrid

FOOT = 0.08
"""How far the foot of an arm reaches in front of its base, in m."""


@dataclass
class FloatingHand:
    """The Franka hand on four axes, x, y, z and yaw: the paper's robot.

    The scenario's `controller` holds its gains.
    """

    def validate(self, grid: PixelGrid) -> None:
        """Accepts all."""


@dataclass
class FrankaArm:
    """A Franka arm with its hand."""

    # fr3 (Franka Research 3) or panda (Franka Emika Robot).
    model: str = "fr3"

    # The base: x, y, z in m, and its rotation about the world's z. At zero it faces +x. From here
    # it reaches all of the default kitting scenes, nearly all with the arm in a vertical plane.
    base: list[float] = bounded([0.04, 0.0, 0.0], -3.0, 3.0)
    yaw_deg: float = bounded(0.0, -180.0, 180.0)

    # Joint impedance, base to flange, in N m/rad and N m s/rad: see `systems.joint_controller`.
    # libfranka offers up to 14250; stiff or damped joints hit harder when the hand touches.
    stiffness: list[float] = bounded(
        [1200.0, 1200.0, 1200.0, 1000.0, 1000.0, 800.0, 800.0], 0.0, 14250.0
    )
    damping: list[float] = bounded([55.0, 75.0, 55.0, 50.0, 22.0, 18.0, 18.0], 0.0, 1000.0)

    # Viscous friction of each joint in N m s/rad, which the controller does not know. A real arm
    # compensates most of its friction.
    friction: list[float] = bounded([0.003] * 7, 0.0, 100.0)

    # It waits at planner.home, but no higher than this, in m: there it hides nothing from the
    # default cameras, and heights above 0.28 m are not part of o_t.
    highest_wait: float = bounded(0.31, 0.0, 2.0)

    # Standard deviation of the estimated external joint torques, from which the arm computes the
    # force on its hand, in N m.
    torque_noise: float = bounded(0.0, 0.0, 10.0)

    def validate(self, grid: PixelGrid) -> None:
        """Checks what ranges cannot express.

        Args:
            grid: the workspace.

        Raises:
            ValueError: the model is unknown, or the base is in the workspace or in the table.
        """
        if self.model not in ARM_LIMITS:
            raise ValueError(
                f"robot.model is '{self.model}', an unknown arm: use {' or '.join(ARM_LIMITS)}"
            )
        base = np.array(self.base[:2])
        at = f"({base[0]:g}, {base[1]:g})"
        lower, upper = (grid.x_min, grid.y_min), (grid.x_max, grid.y_max)
        away = float(np.linalg.norm(base - np.clip(base, lower, upper)))
        if away < FOOT:
            raise ValueError(
                f"robot.base is {at}, but there the arm's foot stands in the workspace: keep "
                f"{FOOT:g} m from x {lower[0]:g} to {upper[0]:g} and y {lower[1]:g} to "
                f"{upper[1]:g}"
            )
        on_table = np.linalg.norm(base - np.clip(base, *TABLE)) < FOOT
        if on_table and self.base[2] < 0:
            raise ValueError(
                f"robot.base[2] is {self.base[2]:g}, inside the table at {at}: use at least 0"
            )

    def arm_base(self) -> ArmBase:
        """The pose of its base."""
        x, y, z = self.base
        return ArmBase(x, y, z, math.radians(self.yaw_deg))


Robot = FloatingHand | FrankaArm
