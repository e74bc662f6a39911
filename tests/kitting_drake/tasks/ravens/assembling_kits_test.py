"""Scenes and measures of success of assembling-kits, without physics."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from kitting_drake.common.errors import UserError
from kitting_drake.episode.episode import object_results
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools import symmetry
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.scenario import Scenario
from kitting_drake.tasks import AssemblingKits
from kitting_drake.tasks.ravens.assembling_kits import PLACES
from kitting_drake.tasks.task import Scene
from systems.placement import ALL, PlacedObject, evaluate_placements
from systems.signals import PixelGrid
from tests.kitting_drake.rig import build_rig


def write_prism(path: Path, outline: CrossSection) -> None:
    """Writes a prism in Ravens' units, which are 3 mm in x and y and 1 mm in z."""
    vertices, faces = vertices_and_faces(outline.extrude(20.0))
    trimesh.Trimesh(vertices, faces, process=False).export(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with two shapes: a triangle and a disc."""
    path = tmp_path_factory.mktemp("shapes")
    write_prism(path / "triangle.obj", CrossSection.circle(11.0, 3))
    write_prism(path / "disc.obj", CrossSection.circle(9.0, 96))
    with pytest.MonkeyPatch.context() as patch:
        # Simple shapes need fewer points than tools.
        patch.setattr(symmetry, "_DENSE_SAMPLES", 20_000)
        yield path


def make_scene(task: AssemblingKits, seed: int = 0) -> Scene:
    return task.make_scene(grid=PixelGrid(), seed=seed, base=Path())


def measured(scene: Scene, index: int, offset: RigidTransform) -> dict[str, bool]:
    """For each measure of success, whether an object succeeds at an offset from its goal.

    The task's own measure is called `task`.
    """
    goal = next(goal for goal in scene.goals if index in goal.objects)
    item = scene.objects[index]
    placed = PlacedObject(item.name, BodyIndex(0), item.p_BPoints, item.symmetry, item.axis)
    X_WB = goal.poses[0] @ offset
    alone = dataclasses.replace(goal, objects=(0,))
    (placement,) = evaluate_placements([placed], [alone], scene.success, [X_WB])
    found = {name: rule.share(placement, X_WB) > ALL for name, rule in scene.measures.items()}
    return found | {"strict": placement.strict_success, "task": placement.success}


def turned(scene: Scene, index: int, angle_deg: float, z: float = 0.0) -> RigidTransform:
    """A rotation about the object's axis of symmetry, and a shift along it by `z` (m)."""
    x, y = scene.objects[index].axis or (0.0, 0.0)
    R = RollPitchYaw(0, 0, math.radians(angle_deg))
    return RigidTransform([x, y, z]) @ RigidTransform(R, [0, 0, 0]) @ RigidTransform([-x, -y, 0.0])


def test_a_scene_is_made_from_the_seed(folder: Path):
    task = AssemblingKits(shapes=str(folder))
    scene, again, other = make_scene(task), make_scene(task), make_scene(task, 1)
    assert [item.name for item in scene.objects] == [item.name for item in again.objects]
    for one, two in zip(scene.objects, again.objects, strict=True):
        assert one.X_WB.IsExactlyEqualTo(two.X_WB)
    assert not scene.objects[0].X_WB.IsExactlyEqualTo(other.objects[0].X_WB)
    assert {item.category for item in scene.objects} <= {"triangle", "disc"}
    assert [goal.reward for goal in scene.goals] == pytest.approx([0.2] * 5)
    assert scene.max_actions == 10
    # The cavities are at their places, and the shapes lie on the table.
    X_KW = scene.fixtures[0].X_WF.inverse()
    seated = sorted(
        tuple(np.round((X_KW @ goal.poses[0]).translation()[:2], 6)) for goal in scene.goals
    )
    assert np.array(seated) == pytest.approx(np.array(sorted(PLACES)))
    assert all(item.X_WB.translation()[2] == 0 for item in scene.objects)


def test_measures(folder: Path):
    scene = make_scene(AssemblingKits(shapes=str(folder)))
    index = next(i for i, item in enumerate(scene.objects) if item.category == "triangle")
    every = {"ravens", "maniskill", "add_s", "strict", "task"}

    def passed(offset: RigidTransform) -> set[str]:
        return {name for name, success in measured(scene, index, offset).items() if success}

    assert passed(RigidTransform()) == every
    # The shape is symmetric under a third of a turn.
    assert passed(turned(scene, index, 120.0)) == every
    assert passed(turned(scene, index, 60.0)) == set()
    # ManiSkill is stricter about headings and compares heights; Ravens ignores heights.
    assert passed(turned(scene, index, 8.0)) == every - {"maniskill"}
    assert passed(turned(scene, index, 0.0, 0.0025)) == every - {"strict"}
    assert passed(turned(scene, index, 0.0, 0.02)) == {"ravens", "task"}
    assert passed(RigidTransform([0.015, 0, 0])) == {"maniskill"}


def test_a_disc_has_any_heading(folder: Path):
    scene = make_scene(AssemblingKits(shapes=str(folder)))
    index = next(i for i, item in enumerate(scene.objects) if item.category == "disc")
    assert all(measured(scene, index, turned(scene, index, 7.0)).values())


def test_results_tell_every_measure(folder: Path):
    task = AssemblingKits(shapes=str(folder))
    rig = build_rig(Scenario(task=task, cameras={}))
    context = rig.diagram.CreateDefaultContext()
    results = object_results(rig.station, context, rig.station.placements(context))
    none = dict.fromkeys(("ravens", "maniskill", "add_s", "strict"), False)
    assert [item.measures for item in results] == [none] * 5


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"kit": KitParameters(length=0.21, width=0.2, height=0.03)}, "too large for the places"),
        ({"kit": KitParameters(length=0.28, width=0.2, height=0.021)}, "too low"),
        ({"shapes": "nowhere"}, "task.shapes: there is no folder"),
    ],
)
def test_impossible_scenes_are_refused(
    folder: Path, tmp_path: Path, changes: dict[str, Any], part: str
):
    task = dataclasses.replace(AssemblingKits(shapes=str(folder)), **changes)
    with pytest.raises(UserError, match=part):
        task.make_scene(grid=PixelGrid(), seed=0, base=tmp_path)


@pytest.mark.parametrize("task", [AssemblingKits(split="fresh"), AssemblingKits(scale=[1.0])])
def test_validate(task: AssemblingKits):
    with pytest.raises(ValueError, match="task"):
        task.validate()
