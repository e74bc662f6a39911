import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.hkd.tools.tool import load_tool
from kitting_drake.scenario import load_scenario
from kitting_drake.tasks import Kitting, ToolsetKitting
from kitting_drake.tasks.kitting import settling, starts
from kitting_drake.tasks.kitting.convex_bodies import convex_body
from kitting_drake.tasks.kitting.start_checks import FACES
from kitting_drake.tasks.kitting.start_groups import START_KINDS, _lean, projected
from kitting_drake.tasks.kitting.starts import TRAY_SIZE
from kitting_drake.tasks.task import Scene
from systems.cluttered_table import tilt
from systems.signals import PixelGrid
from tests.kitting_drake.rig import build_rig

GRID = PixelGrid()
TWO = ["combination_wrench", "flat_screwdriver"]
ROWS = ("touching", "crossed", "leaning", "heap", "tray")


def draw(seed: int, **fields) -> Scene:
    return Kitting(**{"tools": TWO, **fields}).make_scene(grid=GRID, seed=seed, base=Path())


def poses(scene: Scene) -> list:
    return [item.X_WB.GetAsMatrix4().tolist() for item in scene.objects]


def overlaps(scene: Scene) -> int:
    outlines = [projected(item.p_BPoints, item.X_WB) for item in scene.objects]
    return sum((a ^ b).area() > 1e-6 for a, b in itertools.combinations(outlines, 2))


def test_apart_has_no_physics(monkeypatch):
    monkeypatch.setattr(settling, "settle", None)
    scene = draw(0)
    assert scene.laying_area is None
    assert [len(item.grasps) for item in scene.objects] == [1, 1]


def test_touching_tools_are_side_by_side():
    scene, again = draw(0, start="touching"), draw(0, start="touching")
    assert poses(scene) == poses(again)
    assert max(tilt(item.X_WB) for item in scene.objects) < 0.02
    points = [item.X_WB.multiply(item.p_BPoints.T).T[:, :2] for item in scene.objects]
    gap = np.linalg.norm(points[0][:, None] - points[1][None], axis=-1).min()
    assert gap < 0.006
    assert scene.max_actions == 2 and scene.laying_area is not None
    assert all(len(item.grasps) > 3 for item in scene.objects)


def test_crossed_tools_lie_on_each_other():
    scene = draw(0, start="crossed")
    assert overlaps(scene) == 1
    assert max(item.X_WB.translation()[2] for item in scene.objects) > 0.003


def test_a_leaning_tool_rests_on_the_block():
    scene = draw(0, start="leaning")
    (leaning,) = [item for item in scene.objects if tilt(item.X_WB) > 0.1]
    (kit,) = scene.fixtures
    top = float(leaning.X_WB.multiply(leaning.p_BPoints.T)[2].max())
    assert top > 0.05
    assert kit.p_FPoints is not None


def test_a_part_shorter_than_the_overhang_leans_too():
    kit, part = SimpleNamespace(size=(0.2, 0.2, 0.04)), SimpleNamespace(length=0.009)
    poses = [_lean(kit, part, side, np.random.default_rng(side)) for side in range(4)]
    assert all(tilt(X_KT) > 0.5 for X_KT in poses)


def test_a_sliver_of_a_tool_is_left_out():
    block = trimesh.creation.box((0.02, 0.02, 0.01))
    sliver = trimesh.creation.box((0.02, 0.01, 0.00002)).apply_translation((0.0, 0.0, 0.02))
    triangles = np.concatenate([block.triangles, sliver.triangles])
    body = convex_body(SimpleNamespace(triangles=triangles, mass=0.1))
    assert len(body.pieces) == 1
    np.testing.assert_allclose(np.ptp(body.pieces[0], axis=0), (0.02, 0.02, 0.01), atol=1e-6)


def test_a_tool_settles_as_convex_pieces():
    tool = load_tool("combination_wrench")
    body = convex_body(tool)
    assert body.mass == pytest.approx(tool.mass)
    np.testing.assert_allclose(
        np.ptp(np.concatenate(body.pieces), axis=0)[0], tool.length, atol=1e-3
    )
    (X_WT,) = settling.settle([body], [RigidTransform([0.5, 0.0, 0.005])], []) or [None]
    assert X_WT is not None and tilt(X_WT) < 0.02
    assert abs(X_WT.translation()[2]) < 1e-3


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"start": "stacked"}, r"task\.start must be one of apart, .*not 'stacked'"),
        ({"faces": "upper"}, r"task\.faces must be one of as_drawn, any"),
        ({"start": "leaning", "tray": True}, r"task\.tray must be false"),
        ({"start": "heap", "distractors": 1}, r"task\.distractors must be 0"),
    ],
)
def test_unknown_starts_raise(fields: dict, reason: str):
    for task in (Kitting(**fields), ToolsetKitting(**fields)):
        with pytest.raises(ValueError, match=reason):
            task.validate()


def test_an_impossible_start_raises(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(starts, "_REDRAWS", 2)
    with pytest.raises(UserError, match=r"^task\.start: 'crossed' needs at least two tools$"):
        draw(0, tools=TWO[:1], start="crossed")
    small = PixelGrid(rows=100, cols=110)
    with pytest.raises(
        UserError, match=r"^task\.start: no valid start 'heap' with 2 tools was found"
    ):
        Kitting(tools=TWO, start="heap").make_scene(grid=small, seed=0, base=Path())


def test_every_row_has_a_scenario():
    for name in ROWS:
        scenario = load_scenario(SCENARIOS / "heaps.yaml", name)
        assert scenario.task.start in START_KINDS
        assert scenario.task.tries == 4


@pytest.mark.slow
@pytest.mark.parametrize("faces", FACES)
def test_a_heap_in_a_tray_stays_in_it(faces: str):
    scene = draw(1, start="heap", tray=True, faces=faces, tools=Kitting().tools)
    tray = scene.fixtures[1]
    for item in scene.objects:
        points = (tray.X_WF.inverse() @ item.X_WB).multiply(item.p_BPoints.T)
        assert (np.abs(points[:2]) < np.array(TRAY_SIZE[:2])[:, None] / 2).all()
    assert overlaps(scene) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_settled_tools_stay_and_the_oracle_kits_them(row: str):
    scenario = load_scenario(SCENARIOS / "heaps.yaml", row, text="cameras: {}")
    rig = build_rig(scenario, seed=1)
    simulator = rig.station.make_simulator(rig.diagram)
    simulator.AdvanceTo(0.09)
    for item, X_WB in zip(
        rig.scene.objects, rig.station.object_poses(simulator.get_context()), strict=True
    ):
        assert np.linalg.norm(X_WB.translation() - item.X_WB.translation()) < 1e-3
    result = build_rig(scenario, seed=1).run()
    told = [(item.name, item.cause) for item in result.objects]
    assert result.strict_success_rate == 1.0, told
