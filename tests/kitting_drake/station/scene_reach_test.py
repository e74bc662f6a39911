import dataclasses
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station import build_station
from kitting_drake.station.robot import make_motion
from kitting_drake.station.scene_reach import check_scene_reach, scene_problems
from kitting_drake.tasks import Kitting
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PixelGrid

BASE = Path(__file__).parent
TASK = Kitting(tools=["claw_hammer", "ring_40x20x10"])


def scenario(*base: float) -> Scenario:
    # The arm reaches this home from all bases.
    planner = PickPlaceParameters(home=[0.3, 0.0, 0.4, 0.0])
    return Scenario(robot=FrankaArm(base=[*base, 0.0]), task=TASK, planner=planner, cameras={})


def test_a_station_without_anything_in_reach_is_refused():
    with pytest.raises(UserError) as raised:
        build_station(scenario(-0.35, 0.0), 3, BASE)
    message = str(raised.value)
    assert message.startswith("robot.base: the arm reaches none of the scene's objects: ")
    assert "is out of the arm's reach at heights between" in message
    assert message.endswith("`benchmark reach` finds a better base")


def test_what_alone_is_out_of_reach_is_named_and_no_error():
    found = scenario(0.1, 0.0)
    scene = TASK.make_scene(grid=PixelGrid(), seed=3, base=BASE)
    motion = make_motion(found)
    assert scene_problems(scene, motion, found.planner) == []
    far = scene.objects[0].X_WB.translation() + [0.6, 0.0, 0.0]
    moved = dataclasses.replace(scene.objects[0], X_WB=_at(scene.objects[0].X_WB, far))
    scene = dataclasses.replace(scene, objects=(moved, *scene.objects[1:]))
    problems = scene_problems(scene, motion, found.planner)
    assert len(problems) == 1
    assert problems[0].startswith(f"{moved.name} at (")
    check_scene_reach(scene, motion, found.planner)


def test_a_tall_thing_matters_only_near_the_wrist():
    found = scenario(0.1, 0.0)
    scene = TASK.make_scene(grid=PixelGrid(), seed=3, base=BASE)
    motion = make_motion(found)
    hammer, ring = scene.objects
    for away, is_possible in ((0.5, True), (0.1, False)):
        x, y, _ = hammer.X_WB.translation()
        tall = dataclasses.replace(ring, X_WB=_at(ring.X_WB, [x, y + away, 0.2]))
        problems = scene_problems(
            dataclasses.replace(scene, objects=(hammer, tall)), motion, found.planner
        )
        assert (not any(hammer.name in problem for problem in problems)) == is_possible


def _at(X_WB, position):
    return type(X_WB)(X_WB.rotation(), position)
