"""The robot arm of a real bench: its model, its base, and its home."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.field_checks import check_fields
from kitting_drake.real_camera.calibrations.yaml_values import matrix, number, read_yaml
from systems.arm_kinematics import ArmBase
from systems.arm_limits import ARM_LIMITS, JOINTS, ArmLimits
from systems.arm_motion import ArmMotion
from systems.arm_trajectory import FASTEST_RATE, SLOWEST_RATE, ArmTrajectory, plan_action
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, SurfaceHeights

_FIELDS = ("model", "base", "yaw_deg", "home", "joints", "rate")
_FARTHEST = 3.0
"""A coordinate that exceeds this, in metres, is probably in millimetres."""


@dataclass(frozen=True)
class BenchRobot:
    """A Franka arm with its hand, beside a table."""

    model: str = "fr3"
    """The arm's model, `fr3` or `panda`."""
    base: ArmBase = dataclasses.field(default_factory=ArmBase)
    """The pose of the arm's base in the calibration's base frame."""
    home: tuple[float, float, float, float] | None = None
    """Where the hand waits: x, y and height of the fingertips in metres, and yaw in radians. None
    means `planner.home` of the simulated cell. After an action the hand returns to this x, at the
    y of the place or as near to it as the arm can reach."""
    joints: tuple[float, ...] | None = None
    """The seven joint positions from which the arm starts, in rad; None for those at `home`."""
    rate: int = FASTEST_RATE
    """The number of points of a trajectory per second."""

    @property
    def limits(self) -> ArmLimits:
        """The limits of the arm's joints."""
        return ARM_LIMITS[self.model]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints' names in Franka's URDF: `fr3_joint1` to `fr3_joint7`, or the Panda's."""
        return tuple(f"{self.model}_joint{number}" for number in range(1, JOINTS + 1))

    def as_dict(self) -> dict[str, Any]:
        """Returns the content of the arm's file, without the field `rate`."""
        base = self.base
        record: dict[str, Any] = {
            "model": self.model,
            "base": [base.x, base.y, base.z],
            "yaw_deg": round(math.degrees(base.yaw), 9),
        }
        record |= {} if self.home is None else {"home": list(self.home)}
        record |= {} if self.joints is None else {"joints": list(self.joints)}
        return record

    def plan(
        self, action: PickPlaceAction, surfaces: SurfaceHeights, parameters: PickPlaceParameters
    ) -> ArmTrajectory | str:
        """Plans the trajectory of an action.

        Args:
            action: a pick and place or a press, in the base frame of the calibration.
            surfaces: the heights around pick and place.
            parameters: the parameters of the motion.

        Returns:
            The trajectory, or a sentence that says why the arm cannot execute the action.

        Raises:
            UserError: the arm cannot reach its home.
        """
        if self.home is not None:
            parameters = dataclasses.replace(parameters, home=list(self.home))
        try:
            motion = ArmMotion(parameters, self.limits, self.base)
        except ValueError as error:
            reason = str(error).removeprefix("planner.home: ")
            raise UserError(f"the robot's {reason}: give another base or home") from error
        joints = None if self.joints is None else np.array(self.joints)
        return plan_action(motion, parameters, action, surfaces, joints=joints, rate=self.rate)


def read_robot(path: Path) -> BenchRobot:
    """Reads the description of an arm; docs/bench.md has an example.

    Raises:
        UserError: a field is missing or invalid. The message names the field.
    """
    content = read_yaml(path)
    check_fields(content, _FIELDS, str(path))
    model = content.get("model", "fr3")
    if model not in ARM_LIMITS:
        raise UserError(f"{path}: model must be {' or '.join(ARM_LIMITS)}, not {model!r}")
    x, y, z = matrix(content.get("base", [0, 0, 0]), 1, 3, f"{path}: base")[0].tolist()
    if max(abs(x), abs(y), abs(z)) > _FARTHEST:
        raise UserError(
            f"{path}: base is ({x:g}, {y:g}, {z:g}), but no coordinate may exceed {_FARTHEST:g} m: "
            "give metres, not millimetres"
        )
    yaw = number(content.get("yaw_deg", 0), f"{path}: yaw_deg")
    home = joints = None
    if "home" in content:
        a, b, c, d = matrix(content["home"], 1, 4, f"{path}: home")[0].tolist()
        home = (a, b, c, d)
    if "joints" in content:
        joints = tuple(matrix(content["joints"], 1, JOINTS, f"{path}: joints")[0].tolist())
        limits = ARM_LIMITS[model]
        for i, (q, low, high) in enumerate(zip(joints, limits.lower, limits.upper, strict=True)):
            if not low < q < high:
                raise UserError(f"{path}: joints[{i}] is {q:g}, outside of {low:g} to {high:g} rad")
    rate = check_rate(content.get("rate", FASTEST_RATE), f"{path}: rate")
    return BenchRobot(model, ArmBase(x, y, z, math.radians(yaw)), home, joints, rate)


def check_rate(value: object, where: str) -> int:
    """Checks the number of a trajectory's points per second.

    Raises:
        UserError: the value is out of range. The message names the field.
    """
    rate = number(value, where)
    if rate != int(rate) or not SLOWEST_RATE <= rate <= FASTEST_RATE:
        raise UserError(
            f"{where} must be a whole number from {SLOWEST_RATE} to {FASTEST_RATE} Hz, not {rate:g}"
        )
    return int(rate)
