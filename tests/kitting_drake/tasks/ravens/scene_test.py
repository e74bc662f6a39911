"""The Ravens scenes, tested with the plant's collision geometry."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import HydroelasticContactRepresentation
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.schema import Scenario, Sleep
from kitting_drake.tasks import (
    AlignBoxCorner,
    BlockInsertion,
    PalletizingBoxes,
    PlaceRedInGreen,
    StackBlockPyramid,
)
from kitting_drake.tasks.task import Scene, TaskConfig
from systems.grasp import Grasp
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PixelGrid
from tests.kitting_drake.rig import Rig, build_rig

TASKS = [AlignBoxCorner, BlockInsertion, PlaceRedInGreen, StackBlockPyramid, PalletizingBoxes]
SEEDS = [0, pytest.param(1, marks=pytest.mark.slow)]

each_task = pytest.mark.parametrize("kind", TASKS)


def make_scene(task: TaskConfig, seed: int) -> Scene:
    return task.make_scene(grid=PixelGrid(), seed=seed, base=Path())


def there_at_first(scene: Scene) -> list[int]:
    """The indices of the objects that are present initially."""
    later = () if scene.arrivals is None else scene.arrivals.objects
    return [index for index in range(len(scene.objects)) if index not in later]


@functools.cache
def shared_cell(kind: type[TaskConfig], seed: int) -> Rig:
    return build_rig(Scenario(task=kind(), cameras={}), seed=seed, base=Path())


class Posed:
    """A scene in which a test poses the objects and the hand.

    Every object is raised a little, higher objects more, so that no object touches its support.
    Every contact is therefore an error.
    """

    def __init__(self, kind: type[TaskConfig], seed: int) -> None:
        rig = shared_cell(kind, seed)
        self.scene, self._plant, self._bodies = (
            rig.scene,
            rig.plant,
            rig.objects,
        )
        self._root = rig.diagram.CreateDefaultContext()
        self._context = rig.plant.GetMyMutableContextFromRoot(self._root)
        self.poses = [item.X_WB for item in self.scene.objects]
        for index, X_WB in enumerate(self.poses):
            self.put(index, X_WB)

    def put(self, index: int, X_WB: RigidTransform) -> None:
        self.poses[index] = X_WB
        raised = RigidTransform([0, 0, 0.0015 + 0.05 * X_WB.translation()[2]]) @ X_WB
        body = self._plant.get_body(self._bodies[index].body)
        self._plant.SetFreeBodyPose(self._context, body, raised)

    def take_away(self, index: int) -> None:
        self.put(index, RigidTransform([index, 3.0, 1.0]))

    def put_hand(self, index: int, grasp: Grasp, opening: float) -> None:
        """Puts the hand at an object's grasp, at the greatest grasp depth; `opening` is in m."""
        gripper = gripper_pose(self.poses[index], grasp)
        z = self.poses[index].translation()[2] + grasp.surface_height
        z -= PickPlaceParameters().max_grasp_depth
        self._plant.SetPositions(
            self._context,
            self._plant.GetModelInstanceByName("franka_hand"),
            [gripper.x, gripper.y, z, gripper.theta, opening / 2, opening / 2],
        )

    def contacts(self) -> set[tuple[str, ...]]:
        """The pairs of bodies that touch, by name."""
        query = self._plant.get_geometry_query_input_port().Eval(self._context)
        inspector = query.inspector()
        surfaces = query.ComputeContactSurfaces(HydroelasticContactRepresentation.kPolygon)
        return {
            tuple(
                str(self._plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).scoped_name())
                for geometry in (surface.id_M(), surface.id_N())
            )
            for surface in surfaces
        }


@each_task
def test_the_seed_determines_the_scene(kind: type[TaskConfig]):
    def drawn(seed: int) -> tuple:
        scene = make_scene(kind(), seed)
        return (
            [(item.name, item.model, item.X_WB.GetAsMatrix4().tolist()) for item in scene.objects],
            [(it.name, it.model, it.X_WF.GetAsMatrix4().tolist()) for it in scene.fixtures],
        )

    assert drawn(3) == drawn(3)
    assert drawn(3) != drawn(4)


@each_task
def test_all_objects_are_in_the_workspace(kind: type[TaskConfig]):
    for seed in range(10):
        scene = make_scene(kind(), seed)
        poses = {index: scene.objects[index].X_WB for index in there_at_first(scene)}
        if scene.arrivals is not None:
            poses |= dict(zip(scene.arrivals.objects, scene.arrivals.poses, strict=True))
        assert len(poses) == len(scene.objects)
        for index, X_WB in poses.items():
            corners = X_WB.multiply(scene.objects[index].p_BPoints.T)
            assert 0.25 <= corners[0].min() < corners[0].max() <= 0.75, seed
            assert -0.5 <= corners[1].min() < corners[1].max() <= 0.5, seed
            assert corners[2].min() == pytest.approx(X_WB.translation()[2])
        for goal in scene.goals:
            points = scene.objects[goal.objects[0]].p_BPoints.T
            for X_WGoal in goal.poses:
                assert PixelGrid().contains(X_WGoal.multiply(points)[:2].T).all(), seed


@each_task
@pytest.mark.parametrize("seed", SEEDS)
def test_objects_are_free_and_reachable(kind: type[TaskConfig], seed: int):
    """No objects touch at first. If they are taken highest first, the open hand has room."""
    posed = Posed(kind, seed)
    assert posed.contacts() == set()
    opening = PickPlaceParameters().open_width
    height = [X_WB.translation()[2] for X_WB in posed.poses]
    lie_there = [i for i in posed.scene.goal_objects if i in there_at_first(posed.scene)]
    for index in sorted(lie_there, key=lambda index: -height[index]):
        for grasp in posed.scene.objects[index].grasps:
            posed.put_hand(index, grasp, opening)
            assert posed.contacts() == set(), (index, grasp)
        # The closed jaws touch the object.
        posed.put_hand(index, grasp, grasp.width - 0.002)
        assert len(posed.contacts()) >= 2
        posed.take_away(index)


@each_task
@pytest.mark.parametrize("seed", SEEDS)
def test_goals_are_free_and_reachable(kind: type[TaskConfig], seed: int):
    """If goals are filled in order, the hand has room to open at each of them."""
    posed = Posed(kind, seed)
    filled: set[int] = set()
    taken: list[np.ndarray] = []
    for goal in posed.scene.goals:
        index = next(index for index in goal.objects if index not in filled)
        filled.add(index)
        X_WGoal = next(
            X for X in goal.poses if all(np.linalg.norm(X.translation() - p) > 0.01 for p in taken)
        )
        taken.append(X_WGoal.translation())
        posed.put(index, X_WGoal)
        obstructed = []
        for grasp in posed.scene.objects[index].grasps:
            posed.put_hand(index, grasp, grasp.width + 2 * PickPlaceParameters().release_clearance)
            obstructed.append(posed.contacts())
        assert set() in obstructed, goal.name


@each_task
def test_objects_come_to_rest_at_once(kind: type[TaskConfig]):
    """Light and stiff boxes must not chatter on the table, or they would never sleep."""
    rig = shared_cell(kind, 1)
    simulator = rig.station.make_simulator(rig.diagram)
    simulator.AdvanceTo(0.4)
    assert rig.station.at_rest(simulator.get_context()).all()
    poses = rig.station.object_poses(simulator.get_context())
    for index in there_at_first(rig.scene):
        assert poses[index].IsNearlyEqualTo(rig.scene.objects[index].X_WB, 3e-4)


@pytest.mark.parametrize("sleeps", [True, False])
def test_boxes_appear_one_at_a_time(sleeps: bool):
    """The second box appears when the first is on the pallet; the third still waits."""
    scenario = Scenario(
        task=PalletizingBoxes(),
        cameras={},
        planner=PickPlaceParameters(observe_settle=10.0),
        sleep=Sleep(enabled=sleeps),
    )
    rig = build_rig(scenario)
    simulator = rig.station.make_simulator(rig.diagram)
    simulator.AdvanceTo(0.25)
    root = simulator.get_mutable_context()
    context = rig.plant.GetMyMutableContextFromRoot(root)
    first = rig.plant.get_body(rig.objects[0].body)
    rig.plant.SetFreeBodyPose(context, first, rig.scene.goals[0].poses[0])
    simulator.AdvanceTo(1.0)
    _, second, *waiting = rig.station.object_poses(root)
    X_WArrived = rig.scene.arrivals.poses[0]
    assert second.translation()[2] == pytest.approx(0.0, abs=2e-4)
    assert second.translation()[:2] == pytest.approx(X_WArrived.translation()[:2], abs=1e-3)
    for X_WB, item in zip(waiting, rig.scene.objects[2:], strict=True):
        assert X_WB.IsNearlyEqualTo(item.X_WB, 1e-3)


def test_surface_points_span_the_object():
    """An object's position is that of the middle of its points' bounding box. So the points must
    reach the object's ends."""
    block = make_scene(BlockInsertion(), 0).objects[0]
    np.testing.assert_allclose(block.p_BPoints.min(axis=0), [-0.015, -0.015, 0], atol=1e-12)
    np.testing.assert_allclose(block.p_BPoints.max(axis=0), [0.065, 0.065, 0.04], atol=1e-12)
    box = make_scene(AlignBoxCorner(), 0).objects[0]
    span = np.ptp(box.p_BPoints, axis=0)
    assert 0.03 <= span[0] <= 0.07
    assert 0.03 <= span[1] <= 0.07
    assert 0.03 <= span[2] <= 0.06
    assert box.symmetry == 2
    (grasp,) = box.grasps
    assert grasp.width == pytest.approx(span[1] if grasp.theta == 0 else span[0])


def test_red_in_green_draws_bowls_cubes_and_distractors():
    counts = set()
    for seed in range(20):
        scene = make_scene(PlaceRedInGreen(), seed)
        red = [item for item in scene.objects if item.name.endswith("_red")]
        green = [item for item in scene.fixtures if item.name.endswith("_green")]
        assert [scene.objects.index(item) for item in red] == list(scene.goal_objects)
        assert len(scene.goals) == len(red) <= len(green) == len(scene.goals[0].poses) <= 3
        assert len(scene.objects) + len(scene.fixtures) == len(red) + len(green) + 10
        counts.add((len(green), len(red)))
    assert len(counts) >= 5


@each_task
def test_only_default_parameters_have_the_literatures_title(kind: type[TaskConfig]):
    task = kind()
    assert task.title == "".join(f"-{c.lower()}" if c.isupper() else c for c in kind.__name__)[1:]
    changes = [item for item in dataclasses.fields(task) if isinstance(item.default, int | float)]
    for change in changes:
        changed = dataclasses.replace(task, **{change.name: getattr(task, change.name) / 2})
        assert changed.title == f"{task.title}, changed"


def test_invalid_parameters_raise():
    with pytest.raises(ValueError, match=r"task\.box_sides"):
        AlignBoxCorner(box_sides=[0.06, 0.04]).validate()
    with pytest.raises(UserError, match="no free space"):
        PlaceRedInGreen().make_scene(grid=PixelGrid(rows=50, cols=100), seed=0, base=Path())
    with pytest.raises(UserError, match="heightmap"):
        PalletizingBoxes().make_scene(grid=PixelGrid(cols=240), seed=0, base=Path())
