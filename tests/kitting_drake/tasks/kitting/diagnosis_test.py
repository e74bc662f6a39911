import dataclasses
import math
from pathlib import Path

import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from kitting_drake.tasks import Kitting
from kitting_drake.tasks.task import ActionRecord, Scene
from systems.placement import PlacedObject, evaluate_placements
from systems.signals import PixelGrid, PlanarPose

TOOL = 0


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Kitting().make_scene(grid=PixelGrid(), seed=0, base=Path())


def flat(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


def record(scene: Scene, outcome: str, place_error_mm: float = 1.0, tool: int = TOOL):
    item = scene.objects[tool]
    nowhere = PlanarPose()
    return ActionRecord(
        item.name, item.category, outcome, nowhere, nowhere, 1.0, 1.0, place_error_mm, 1.0
    )


def cause(scene: Scene, X_GoalB: RigidTransform, *records: ActionRecord) -> str:
    """The cause of failure of a tool whose final pose in its goal's frame is X_GoalB.

    All other tools are kitted.
    """
    X_WB = [goal.poses[0] for goal in scene.goals]
    X_WB[TOOL] = X_WB[TOOL] @ X_GoalB
    objects = [
        PlacedObject(item.name, BodyIndex(index), item.p_BPoints, item.symmetry)
        for index, item in enumerate(scene.objects)
    ]
    placement = evaluate_placements(objects, scene.goals, scene.success, X_WB)[TOOL]
    assert not placement.success
    task = Kitting()
    found = task.find_cause(scene, TOOL, X_WB, placement, records)
    assert found in task.causes
    return found


def test_causes_of_an_object_that_was_never_held(scene: Scene):
    beside = flat(0.3, 0.0)
    assert cause(scene, beside) == "never picked"
    assert cause(scene, beside, record(scene, "unfinished")) == "never picked"
    assert cause(scene, beside, record(scene, "unreachable")) == "never picked"
    assert cause(scene, beside, record(scene, "missed")) == "missed grasp"
    assert cause(scene, beside, record(scene, "placed", tool=1)) == "never picked"


@pytest.mark.parametrize("outcome", ["placed", "dropped"])
def test_causes_at_its_own_cavity(scene: Scene, outcome: str):
    done = record(scene, outcome)
    # If a grasp of the placed tool is missed later, the cause stays the same.
    for records in ([done], [done, record(scene, "missed")]):
        assert cause(scene, flat(0.004, 0.01, 0.2, 0.012), *records) == "insertion blocked"
        assert cause(scene, flat(0.0, 0.0, math.pi - 0.1), *records) == "reversed"
        face_down = RigidTransform(RollPitchYaw(math.pi, 0, 0), [0, 0.012, 0.03])
        assert cause(scene, face_down, *records) == "reversed"


def test_half_a_rotation_about_the_grasp_is_reversed(scene: Scene):
    (grasp,) = scene.objects[TOOL].grasps
    X_BGrasp = flat(grasp.x, grasp.y)
    reversed_there = X_BGrasp @ flat(0, 0, math.pi) @ X_BGrasp.inverse()
    assert cause(scene, reversed_there, record(scene, "placed")) == "reversed"


def test_a_reversible_tool_cannot_be_reversed(scene: Scene):
    items = list(scene.objects)
    items[TOOL] = dataclasses.replace(items[TOOL], symmetry=2)
    reversible = dataclasses.replace(scene, objects=tuple(items))
    protruding = flat(0.0, 0.0, math.pi, 0.012)
    assert cause(scene, protruding, record(scene, "placed")) == "reversed"
    assert cause(reversible, protruding, record(scene, "placed")) == "insertion blocked"


def test_causes_elsewhere(scene: Scene):
    placed, dropped = record(scene, "placed"), record(scene, "dropped")
    meant_elsewhere = record(scene, "placed", place_error_mm=90.0)
    off_the_kit = flat(0.3, 0.0)
    assert cause(scene, off_the_kit, dropped) == "slipped"
    assert cause(scene, off_the_kit, placed) == "slipped"
    assert cause(scene, off_the_kit, meant_elsewhere) == "misplaced"
    across = flat(0.0, 0.0, math.pi / 2)
    assert cause(scene, across, placed) == "misplaced"
    own, another = (scene.goals[index].poses[0] for index in (TOOL, 1))
    over_another = own.InvertAndCompose(another)
    assert cause(scene, over_another, meant_elsewhere) == "wrong cavity"
    assert cause(scene, over_another @ flat(0, 0, math.pi), placed) == "wrong cavity"
    assert cause(scene, over_another, dropped) == "slipped"
