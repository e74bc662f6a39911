import math

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator

from systems.attempt_memory import nearest_grasp
from systems.grasp import Grasp
from systems.oracle_policy import OraclePolicy, gripper_pose
from systems.pick_place_parameters import Mode
from systems.placement import Goal, PlacedObject
from systems.signals import PickPlaceAction, PlanarPose
from systems.success import AddS

BOX = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.02, 0.02) for z in (0, 0.02)])
MIDDLE, END = Grasp(0.0, 0.0, 0.0, 0.04, 0.02), Grasp(0.03, 0.0, 0.0, 0.04, 0.02)
ACROSS = Grasp(0.0, 0.0, math.pi / 2, 0.04, 0.02)
FIRST = RigidTransform(RollPitchYaw(0, 0, 0.4), [0.4, 0.2, 0])
SECOND = RigidTransform(RollPitchYaw(0, 0, -1.0), [0.6, -0.2, 0])


def test_the_nearest_grasp_is_found_by_place_and_angle():
    grasps = [(MIDDLE, END, ACROSS), (MIDDLE,)]
    for number, grasp in enumerate(grasps[0]):
        pick = gripper_pose(FIRST, grasp)
        turned = PlanarPose(pick.x + 0.001, pick.y, pick.theta + math.pi)
        assert nearest_grasp(grasps, [FIRST, SECOND], turned) == (0, number)
    assert nearest_grasp(grasps, [FIRST, SECOND], gripper_pose(SECOND, MIDDLE)) == (1, 0)
    assert nearest_grasp([()], [FIRST], turned) is None


def _picks(modes: list[Mode], number: int) -> list[tuple[int, int]]:
    """The objects and grasps that an oracle picks if every action passes through the same modes."""
    objects = [PlacedObject(name, BodyIndex(i + 1), BOX) for i, name in enumerate("ab")]
    far = RigidTransform([0.5, 0.4, 0])
    goals = [Goal(item.name, (i,), (far,), 0.5) for i, item in enumerate(objects)]
    oracle = OraclePolicy(objects=objects, grasps=[(MIDDLE, END)] * 2, goals=goals, success=AddS())
    simulator = Simulator(oracle)
    context = simulator.get_mutable_context()
    poses = [RigidTransform(), FIRST, SECOND]
    oracle.GetInputPort("body_poses").FixValue(context, Value(poses))
    accepted = oracle.GetInputPort("accepted_action").FixValue(context, Value(PickPlaceAction()))
    mode = oracle.GetInputPort("mode").FixValue(context, [Mode.OBSERVE])
    simulator.Initialize()
    taken = []
    for _ in range(number):
        action = oracle.GetOutputPort("action").Eval(context)
        taken.append(nearest_grasp([(MIDDLE, END)] * 2, poses[1:], action.pick))
        accepted.GetMutableData().set_value(action)
        for now in modes:
            mode.GetMutableData().get_mutable_value().SetFromVector([now])
            simulator.AdvanceTo(context.get_time() + 1 / 16)
    return taken


def test_a_slip_costs_the_others_nothing_and_the_next_grasp_is_another():
    taken = _picks([Mode.APPROACH, Mode.RETREAT, Mode.OBSERVE], 4)
    assert taken == [(0, 0), (1, 0), (0, 1), (1, 1)]


def test_an_object_that_was_set_down_is_gripped_there_again_but_not_forever():
    modes = [Mode.APPROACH, Mode.LIFT, Mode.LOWER, Mode.RELEASE, Mode.RETREAT, Mode.OBSERVE]
    assert _picks(modes, 10) == [(0, 0)] * 4 + [(1, 0)] * 4 + [(0, 1)] * 2
