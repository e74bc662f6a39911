"""The types of robots in a scenario.

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
"""How far the foot of an arm extends in front of the origin of the arm's base frame, in m."""


@dataclass
class FloatingHand:
    """The Franka hand on four axes, x, y, z and yaw: the paper's robot.

    The scenario's `controller` holds its gains.
    """

    def validate(self, grid: PixelGrid) -> None:
        """Does nothing: there is nothing to check."""


@dataclass
class FrankaArm:
    """A Franka arm with its hand."""

    # fr3 (Franka Research 3) or panda (Franka Emika Robot).
    model: str = "fr3"

    # Pose of the base: x, y, z in the world, in m. At zero rotation the arm faces +x. From the
    # default position it reaches everything in the default kitting scenes, nearly always with the
    # whole arm in one vertical plane.
    base: list[float] = bounded([0.04, 0.0, 0.0], -3.0, 3.0)
    yaw_deg: float = bounded(0.0, -180.0, 180.0)

    # Stiffness and damping of the joints, from base to flange, in N m/rad and N m s/rad; see
    # `systems.joint_controller`. libfranka allows stiffnesses up to 14250. Stiffer or more damped
    # joints cause larger impact forces.
    stiffness: list[float] = bounded(
        [1200.0, 1200.0, 1200.0, 1000.0, 1000.0, 800.0, 800.0], 0.0, 14250.0
    )
    damping: list[float] = bounded([55.0, 75.0, 55.0, 50.0, 22.0, 18.0, 18.0], 0.0, 1000.0)

    # Viscous friction of each joint in N m s/rad. The controller does not compensate it. The
    # default is small, because a real arm compensates most of its friction.
    friction: list[float] = bounded([0.003] * 7, 0.0, 100.0)

    # The hand waits at planner.home, but no higher than this, in m. At the default height the hand
    # hides at most 11 mm of the workspace's border from one of the default cameras. This height is
    # above the highest point that the observation o_t can show, at 0.28 m (heightmap.z_max).
    highest_wait: float = bounded(0.31, 0.0, 2.0)

    # Standard deviation of the noise of the external joint torques, in N m, from which the arm
    # estimates the contact force on its hand.
    torque_noise: float = bounded(0.0, 0.0, 10.0)

    def validate(self, grid: PixelGrid) -> None:
        """Checks the constraints that types and ranges cannot express.

        Args:
            grid: pixel grid of the workspace.

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
                f"robot.base is {at}, but there the arm's foot stands in the workspace: keep the "
                f"base {FOOT:g} m away from the workspace, which is x {lower[0]:g} to {upper[0]:g} "
                f"and y {lower[1]:g} to {upper[1]:g}"
            )
        on_table = np.linalg.norm(base - np.clip(base, *TABLE)) < FOOT
        if on_table and self.base[2] < 0:
            raise ValueError(
                f"robot.base[2] is {self.base[2]:g}, inside the table at {at}: use at least 0"
            )

    def arm_base(self) -> ArmBase:
        """The pose of the arm's base."""
        x, y, z = self.base
        return ArmBase(x, y, z, math.radians(self.yaw_deg))


Robot = FloatingHand | FrankaArm
