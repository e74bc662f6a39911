import dataclasses

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator

from systems.pick_place_parameters import Mode
from systems.placement import Goal, PlacedObject, evaluate_placements
from systems.placement_monitor import PlacementMonitor
from systems.success import AddS

POINTS = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
OBJECTS = [PlacedObject(name, BodyIndex(i + 1), POINTS) for i, name in enumerate("abc")]
GOALS = [
    Goal("first", (0,), (RigidTransform([0.5, 0, 0]),), 0.75),
    Goal("second", (1,), (RigidTransform([0.6, 0, 0]),), 0.25),
]
VECTORS = ("success", "add_s", "position_error", "angle_error", "height_error")


def monitor(objects=OBJECTS, goals=GOALS) -> PlacementMonitor:
    return PlacementMonitor(objects=objects, goals=goals, success=AddS(0.01))


def test_ports():
    system = monitor()
    assert system.num_input_ports() == 2
    assert system.GetInputPort("body_poses").get_index() == 0
    assert system.GetInputPort("mode").size() == 1
    names = [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
    assert names == ["placements", "reward", *VECTORS, "kept_goals"]
    assert system.GetOutputPort("kept_goals").size() == 2
    assert system.GetOutputPort("reward").size() == 1
    assert all(system.GetOutputPort(name).size() == 3 for name in VECTORS)


def test_outputs_equal_evaluate_placements():
    system = monitor()
    context = system.CreateDefaultContext()
    poses = [RigidTransform([0.5, 0, 0.001]), RigidTransform([0.6, 0.1, 0]), RigidTransform()]
    system.GetInputPort("body_poses").FixValue(context, Value([RigidTransform(), *poses]))
    expected = evaluate_placements(OBJECTS, GOALS, AddS(0.01), poses)
    assert system.placements(context) == expected
    assert system.GetOutputPort("reward").Eval(context).tolist() == [0.75]
    for name in VECTORS:
        values = [float(getattr(item, name)) for item in expected]
        np.testing.assert_array_equal(system.GetOutputPort(name).Eval(context), values)
    # For the last object no goal is left.
    assert system.GetOutputPort("add_s").Eval(context)[2] == np.inf


def test_a_stage_that_was_complete_when_an_action_began_is_kept():
    staged = [GOALS[0], dataclasses.replace(GOALS[1], after=(0,))]
    system = monitor(goals=staged)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    away, (first, second) = RigidTransform(), (goal.poses[0] for goal in staged)

    def advance(mode: Mode, *poses: RigidTransform) -> list[float]:
        bodies = [RigidTransform(), *poses, away]
        system.GetInputPort("body_poses").FixValue(context, Value(bodies))
        system.GetInputPort("mode").FixValue(context, [float(mode)])
        simulator.AdvanceTo(context.get_time() + 1 / 32)
        return system.GetOutputPort("kept_goals").Eval(context).tolist()

    assert advance(Mode.OBSERVE, first, away) == [0.0, 0.0]
    # To be kept, a stage must be complete at the moment when an action begins.
    assert advance(Mode.APPROACH, away, away) == [0.0, 0.0]
    assert advance(Mode.CARRY, first, away) == [0.0, 0.0]
    assert advance(Mode.OBSERVE, first, away) == [0.0, 0.0]
    assert advance(Mode.APPROACH, first, away) == [1.0, 0.0]
    assert system.reward(context) == 0.75
    # From then on the stage counts as filled, even if its object leaves. So a filled later goal is
    # rewarded.
    assert advance(Mode.RETREAT, away, second) == [1.0, 0.0]
    assert system.GetOutputPort("reward").Eval(context).tolist() == [1.0]
    # The kept goals are stored in the context, not in the system.
    clone = context.Clone()
    assert system.reward(clone) == 1.0
    system.SetDefaultContext(context)
    assert system.GetOutputPort("kept_goals").Eval(context).tolist() == [0.0, 0.0]


def test_invalid_goals_and_objects_raise():
    with pytest.raises(ValueError, match="goal"):
        monitor(goals=[])
    with pytest.raises(ValueError, match="nobody"):
        monitor(goals=[Goal("nobody", (), (RigidTransform(),), 1.0)])
    with pytest.raises(ValueError, match="spoon"):
        monitor(objects=[PlacedObject("spoon", BodyIndex(1), np.zeros((0, 3)))])
