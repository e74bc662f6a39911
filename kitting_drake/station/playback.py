"""Plays a joint trajectory back in a scenario's plant, without planner, cameras and policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station.control import drive_arm
from kitting_drake.station.plant import add_models, add_plant, set_initial_poses
from kitting_drake.station.robot import ARM_JOINT_NAMES, FINGER_NAMES, add_robot
from systems.arm_limits import JOINTS
from systems.arm_trajectory import ArmTrajectory
from systems.trajectory_source import TrajectorySource


@dataclass(frozen=True)
class Playback:
    """The recorded motion of the plant after each of its n steps, in SI units and radians."""

    time: NDArray[np.float64]
    """(n) times since the start, in s."""
    commanded: NDArray[np.float64]
    """(n, 21) commanded positions, velocities and accelerations of the joints, from the
    trajectory."""
    position: NDArray[np.float64]
    """(n, 7) positions of the joints. `velocity` and `torque` hold their velocities and torques."""
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]
    object_poses: tuple[RigidTransform, ...]
    """X_WB of each of the scene's objects at the end."""


def play_trajectory(
    scenario: Scenario,
    trajectory: ArmTrajectory,
    *,
    seed: int = 0,
    base: Path | None = None,
    seconds: float | None = None,
) -> Playback:
    """Plays a trajectory back with the controller and plant of a station.

    Contacts do not stop the trajectory: segments with a `stop_force` continue to their end.

    Args:
        scenario: a scenario with the arm for which the trajectory was planned.
        trajectory: the trajectory. The arm is at its first point at time zero.
        seed: seed of the scene.
        base: base folder of the scenario's relative paths; None for the working directory.
        seconds: simulated time; None stands for 0.2 s after the trajectory's end.

    Raises:
        UserError: the scenario's robot is not an arm.
    """
    robot = scenario.robot
    if not isinstance(robot, FrankaArm):
        raise UserError("robot is a floating hand: a joint trajectory needs !FrankaArm")
    grid = scenario.heightmap.grid()
    folder = Path.cwd() if base is None else base
    scene = scenario.task.make_scene(grid=grid, seed=seed, base=folder)
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, scenario)
    objects, _ = add_models(plant, scene, scenario.variation, seed)
    add_robot(plant, robot)
    plant.Finalize()
    set_initial_poses(plant, scene, objects)
    starts = [*trajectory.positions[0].tolist(), *[trajectory.start_width / 2] * 2]
    for name, position in zip((*ARM_JOINT_NAMES, *FINGER_NAMES), starts, strict=True):
        plant.GetJointByName(name).set_default_positions([position])
    driven = drive_arm(builder, scenario, robot, plant, seed)
    source = builder.AddNamedSystem("trajectory", TrajectorySource(trajectory))
    for port in ("desired_motion", "desired_opening", "closing_force"):
        builder.Connect(source.GetOutputPort(port), driven.controller.GetInputPort(port))
    diagram = builder.Build()
    samples: list[list[float]] = []

    def sample(root: Context) -> EventStatus:
        def value(port: object) -> NDArray[np.float64]:
            return port.Eval(port.get_system().GetMyContextFromRoot(root))  # type: ignore[attr-defined]

        state = value(driven.robot_state)
        joints, rates = state[:JOINTS], state[len(state) // 2 :][:JOINTS]
        commanded = trajectory.at(root.get_time())
        torque = value(driven.actuation)[:JOINTS]
        samples.append([root.get_time(), *commanded, *joints, *rates, *torque])
        return EventStatus.DidNothing()

    simulator = Simulator(diagram)
    simulator.set_monitor(sample)
    simulator.AdvanceTo(trajectory.duration + 0.2 if seconds is None else seconds)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    poses = tuple(plant.get_body(it.body).EvalPoseInWorld(context) for it in objects)
    time, rest = np.array(samples)[:, 0], np.array(samples)[:, 1:]
    commanded, position, velocity, torque = np.split(rest, [21, 28, 35], axis=1)
    return Playback(time, commanded, position, velocity, torque, poses)
