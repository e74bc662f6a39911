"""Adds the robot to the station's plant: the floating hand, or an arm with its hand."""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, PdControllerGains
from pydrake.systems.framework import Context

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.common.sdformat import model_text
from kitting_drake.scenario.robots import FrankaArm, Robot
from kitting_drake.scenario.schema import Scenario
from systems.arm_inertia import ArmInertia
from systems.arm_limits import ARM_LIMITS
from systems.arm_motion import ArmMotion
from systems.floating_hand_motion import HandMotion
from systems.hand_geometry import FINGERTIP_DISTANCE
from systems.robot_motion import RobotMotion

HAND, ARM = "franka_hand", "franka_arm"
"""Names of the model instances of the hand and of the arm."""
HAND_JOINT_NAMES = ("x", "y", "z", "yaw")
ARM_JOINT_NAMES = tuple(f"joint{number}" for number in range(1, 8))
FINGER_NAMES = ("left_finger_slide", "right_finger_slide")
GRIPPER = "gripper"
"""Name of the gripper frame G of an `arm_model`, see `systems.hand_geometry`."""

_X_FLANGEHAND = RigidTransform(RollPitchYaw(0, 0, -math.pi / 4), [0, 0, 0])
_X_HANDG = RigidTransform(RollPitchYaw(math.pi, 0, 0), [0, 0, FINGERTIP_DISTANCE])
_FLOOR = -0.75
"""World z of the floor below the table, in m."""
_PEDESTAL = (0.26, 0.22)
"""Extents of an arm's pedestal along the base's x and y, in m; the arm's foot is 0.23 x 0.19 m."""
_PEDESTAL_MIDDLE = -0.04
"""Position of the middle of the arm's foot along the base's x axis, in m."""


def joint_names(robot: Robot) -> tuple[str, ...]:
    """The names of the joints that move the hand."""
    return ARM_JOINT_NAMES if isinstance(robot, FrankaArm) else HAND_JOINT_NAMES


def add_robot(plant: MultibodyPlant, robot: Robot) -> None:
    """Adds the robot to a plant that is not finalized yet."""
    parser = _parser(plant)
    hand = MODELS / HAND / f"{HAND}.sdf"
    if not isinstance(robot, FrankaArm):
        parser.AddModelsFromString(_text(hand), "sdf")
        return
    _add_arm(parser, plant, robot)
    _add_pedestal(plant, robot)
    arm = plant.GetModelInstanceByName(ARM)
    # A Franka compensates its own weight and that of its hand, so switch off gravity for both.
    for instance in (arm, plant.GetModelInstanceByName(HAND)):
        plant.set_gravity_enabled(instance, False)
    for name, stiffness, damping, friction in zip(
        ARM_JOINT_NAMES, robot.stiffness, robot.damping, robot.friction, strict=True
    ):
        joint = plant.GetJointByName(name, arm)
        joint.set_default_damping_vector([friction])
        actuator = plant.GetJointActuatorByName(name, arm)
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))


def arm_model(robot: FrankaArm) -> tuple[MultibodyPlant, Frame]:
    """Makes a plant that contains only the arm and its hand, without gravity but with the joints'
    friction. Returns it and its gripper frame G."""
    plant = MultibodyPlant(time_step=0.0)
    _add_arm(_parser(plant), plant, robot)
    for name, friction in zip(ARM_JOINT_NAMES, robot.friction, strict=True):
        plant.GetJointByName(name).set_default_damping_vector([friction])
    hand = plant.GetFrameByName("hand")
    plant.AddFrame(FixedOffsetFrame(GRIPPER, hand, _X_HANDG))
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return plant, plant.GetFrameByName(GRIPPER)


def hand_model() -> MultibodyPlant:
    """Makes a plant that contains only the floating hand."""
    plant = MultibodyPlant(time_step=0.0)
    _parser(plant).AddModelsFromString(_text(MODELS / HAND / f"{HAND}.sdf"), "sdf")
    plant.Finalize()
    return plant


def make_motion(scenario: Scenario) -> RobotMotion:
    """Makes the object that computes the motions of the robot.

    Raises:
        UserError: an arm cannot reach the home pose.
    """
    robot = scenario.robot
    if not isinstance(robot, FrankaArm):
        return HandMotion(scenario.planner)
    try:
        return ArmMotion(
            scenario.planner,
            ARM_LIMITS[robot.model],
            robot.arm_base(),
            highest_wait=robot.highest_wait,
            inertia=ArmInertia(arm_model(robot)[0]),
        )
    except ValueError as error:
        raise UserError(str(error)) from error


def set_home(plant: MultibodyPlant, motion: RobotMotion, opening: float) -> None:
    """Sets the plant's default positions so that the robot is at home with open jaws.

    Args:
        plant: the finalized plant.
        motion: computes the robot's motions.
        opening: the distance between the pads, in m.
    """
    names = ARM_JOINT_NAMES if plant.HasModelInstanceNamed(ARM) else HAND_JOINT_NAMES
    start = motion.motion_at(motion.view(motion.initial_state()), 0.0)
    for name, position in zip(names, start[: len(names)].tolist(), strict=True):
        plant.GetJointByName(name).set_default_positions([position])
    for name in FINGER_NAMES:
        plant.GetJointByName(name).set_default_positions([opening / 2])


def _base_pose(robot: FrankaArm) -> RigidTransform:
    """Pose X_WB of the arm's base in the world."""
    base = robot.arm_base()
    return RigidTransform(RollPitchYaw(0, 0, base.yaw), [base.x, base.y, base.z])


def _add_arm(parser: Parser, plant: MultibodyPlant, robot: FrankaArm) -> None:
    """Adds an arm, and the hand at its flange."""
    name = f"franka_{robot.model}"
    parser.AddModelsFromString(_text(MODELS / name / f"{name}.sdf"), "sdf")
    parser.AddModelsFromString(_without_axes(_text(MODELS / HAND / f"{HAND}.sdf")), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("link0"), _base_pose(robot))
    plant.WeldFrames(plant.GetFrameByName("link8"), plant.GetFrameByName("hand"), _X_FLANGEHAND)


def _add_pedestal(plant: MultibodyPlant, robot: FrankaArm) -> None:
    """Adds a visual pedestal for the arm, from the floor up to its base."""
    # End 1 mm below the base: a table at the base's height then hides the pedestal's top.
    height = robot.base[2] - 0.001 - _FLOOR
    if height <= 0:
        return
    X_BPedestal = RigidTransform(RotationMatrix(), [_PEDESTAL_MIDDLE, 0, -0.001 - height / 2])
    plant.RegisterVisualGeometry(
        plant.world_body(),
        _base_pose(robot) @ X_BPedestal,
        Box(*_PEDESTAL, height),
        "pedestal",
        np.array([0.30, 0.31, 0.33, 1.0]),
    )


def _parser(plant: MultibodyPlant) -> Parser:
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
    return parser


def _text(model: Path) -> str:
    text = model_text(model)
    assert text is not None
    return text


def _without_axes(text: str) -> str:
    """Removes the axes x, y, z and yaw from the floating hand's model, for a hand on an arm."""
    root = ElementTree.fromstring(text)
    model = root.find("model")
    assert model is not None
    for element in list(model):
        name = element.get("name", "")
        if name in HAND_JOINT_NAMES or name.startswith("carriage_"):
            model.remove(element)
    return ElementTree.tostring(root, encoding="unicode")


def robot_state(plant: MultibodyPlant, context: Context) -> NDArray[np.float64]:
    """Returns the positions of an arm's joints and fingers, then their velocities (18)."""
    instances = [plant.GetModelInstanceByName(name) for name in (ARM, HAND)]
    positions = [plant.GetPositions(context, instance) for instance in instances]
    velocities = [plant.GetVelocities(context, instance) for instance in instances]
    return np.concatenate([*positions, *velocities])
