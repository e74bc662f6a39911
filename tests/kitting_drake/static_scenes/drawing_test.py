"""Tests of random tools, static scenes, and training samples from them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.common.rendering import can_render
from kitting_drake.hkd.generation.catalogue import ToolEntry, load_catalogue
from kitting_drake.hkd.generation.random_tools import RandomTool, draw_tool
from kitting_drake.policies.data.static_scenes import (
    StaticSamples,
    StaticScene,
    StaticScenes,
    is_static_scenes,
    read_static_scenes,
    write_static_scenes,
)
from kitting_drake.policies.data.training_data import read_training_data
from kitting_drake.scenario.cameras import LookAt
from kitting_drake.static_scenes import drawing as static_scenes
from kitting_drake.tasks.kitting.tool_poses import outline_at
from systems.signals import Observation, PixelGrid

GRID = PixelGrid()
ENTRIES = [e for e in load_catalogue(MODELS / "tools" / "catalogue.yaml") if e.split == "train"]
needs_renderer = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")


@pytest.fixture(scope="module")
def tools() -> list[RandomTool]:
    """Three random tools: one composed of solids, one from a family, and one simple part."""
    return [draw_tool(ENTRIES, np.random.default_rng(seed), str(seed)) for seed in (3, 9, 12)]


def test_random_tools_are_valid_and_distinct(tools: list[RandomTool]):
    for tool in tools:
        low, high = tool.triangles.min(axis=(0, 1)), tool.triangles.max(axis=(0, 1))
        np.testing.assert_allclose(low[2], 0, atol=1e-9)
        np.testing.assert_allclose(low[:2], -high[:2], atol=1e-9)
        np.testing.assert_allclose(high - low, (tool.length, tool.width, tool.height), atol=1e-9)
        shortest = 0.012 if tool.category == "part" else 0.045
        assert shortest < max(tool.length, tool.width) < 0.35
        assert tool.grasps
        assert all(0.003 <= grasp.width <= 0.07 for grasp in tool.grasps)
        assert tool.footprint.area() > 0
    assert [tool.category for tool in tools] == ["composed", "wrench", "part"]
    assert len({round(tool.footprint.area(), 9) for tool in tools}) == len(tools)
    again = draw_tool(ENTRIES, np.random.default_rng(12), "12")
    np.testing.assert_array_equal(again.triangles, tools[2].triangles)


def test_random_tools_derive_from_training_tools_only(monkeypatch: pytest.MonkeyPatch):
    given: list[ToolEntry] = []

    def take_down(entries: list[ToolEntry], *_: object) -> None:
        given.extend(entries)
        raise UserError("seen enough")

    monkeypatch.setattr(static_scenes, "require_rendering", lambda: None)
    monkeypatch.setattr(static_scenes, "draw_tool", take_down)
    with pytest.raises(UserError, match="seen enough"):
        next(static_scenes.draw_batch(0))
    assert len(given) == 40
    assert {entry.split for entry in given} == {"train"}


@pytest.fixture(scope="module")
def scenes(tools: list[RandomTool]) -> list[StaticScene]:
    if not can_render():
        pytest.skip("images cannot be rendered here")
    rng = np.random.default_rng(1)
    kit = static_scenes._draw_kit(tools, rng)
    drawn = [
        static_scenes._draw_scene(kit, tools, (), rng, seed).static_scene() for seed in range(4)
    ]
    return [scene for scene in drawn if scene is not None]


def test_picks_are_on_tools_and_places_are_in_cavities(scenes: list[StaticScene]):
    loose = [scene for scene in scenes if len(scene.actions)]
    assert loose
    for scene in loose:
        height = scene.image[3]
        top = np.percentile(height, 99)
        for row in scene.actions:
            pick, place = (np.rint(GRID.to_pixel(row[i : i + 2])).astype(int) for i in (2, 5))
            around = height[pick[0] - 1 : pick[0] + 2, pick[1] - 1 : pick[1] + 2]
            assert around.max() > 0.003
            # The place is in a cavity: near it, the height reaches the block's top.
            window = height[place[0] - 10 : place[0] + 11, place[1] - 10 : place[1] + 11]
            assert window.max() > 0.8 * top


@needs_renderer
def test_an_action_moves_the_tool_into_a_cavity_of_its_shape(tools: list[RandomTool]):
    """The action's motion brings the tool's pixels into the cavity."""
    rng = np.random.default_rng(5)
    tools = tools[:2]
    kit = static_scenes._draw_kit(tools, rng)
    free = 0
    while not free:
        scene = static_scenes._draw_scene(kit, tools, (), rng, 0).static_scene()
        if scene is None or len(np.unique(scene.actions[:, 0])) < 2:
            continue
        height = scene.image[3]
        block = np.percentile(height, 99)
        for row in scene.actions[:1]:
            pick, place = GRID.to_pixel(row[2:4]), GRID.to_pixel(row[5:7])
            rotation = row[7] - row[4]
            along = np.array([math.cos(row[4]), math.sin(row[4])])
            for step in np.linspace(-6, 6, 7):
                here = np.rint(pick + step * along).astype(int)
                turned = row[4] + rotation
                there = place + step * np.array([math.cos(turned), math.sin(turned)])
                there = np.rint(there).astype(int)
                if height[tuple(here)] > 0.004:
                    free += 1
                    assert height[tuple(there)] < block - 0.003


@needs_renderer
def test_loose_tools_touch_and_kits_stand_on_tilted_risers(
    tools: list[RandomTool], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(static_scenes, "_STARTS", {"touching": 1.0})
    monkeypatch.setattr(static_scenes, "_RAISED", 1.0)
    monkeypatch.setattr(static_scenes, "_TILTED", 1.0)
    monkeypatch.setattr(static_scenes, "_draw_loose", lambda count, _: list(range(count)))
    rng = np.random.default_rng(2)
    kit = static_scenes._draw_kit(tools[:2], rng)
    scene = static_scenes._draw_scene(kit, tools[:2], (), rng, 0)
    one, other = (outline_at(item.tool.footprint, item.X_WT) for item in scene.loose)
    assert (one ^ other).is_empty()
    assert not (one.offset(0.0031) ^ other).is_empty()
    X_WKit = scene.bodies[0][1]
    assert 0.01 <= X_WKit.translation()[2] < 0.08
    assert scene.loose[0].X_WGoal.rotation().matrix()[2, 2] < 1.0 - 1e-9


@needs_renderer
def test_what_no_camera_sees_has_no_label(tools: list[RandomTool]):
    rng = np.random.default_rng(1)
    scene = static_scenes._draw_scene(static_scenes._draw_kit(tools, rng), tools, (), rng, 0)
    assert scene.loose
    aside = LookAt(position=[0.5, 3.1, 1.0], target=[0.5, 3.0, 0.0])
    assert replace(scene, cameras={"aside": aside}).static_scene() is None


def test_scenes_are_unchanged_by_writing_and_reading(scenes: list[StaticScene], tmp_path: Path):
    path = tmp_path / "scenes.h5"
    write_static_scenes(path, StaticScenes(GRID, tuple(scenes), 7, {"drake": "x"}))
    assert is_static_scenes(path)
    found = read_static_scenes(path)
    assert (found.grid, found.first_seed, found.versions) == (GRID, 7, {"drake": "x"})
    for one, other in zip(found.scenes, scenes, strict=True):
        np.testing.assert_array_equal(one.height, other.height)
        np.testing.assert_array_equal(one.actions, other.actions)
    data = read_training_data(path)
    assert (data.count, data.colour, data.seeds) == (len(scenes), False, (7,))
    loose = sum(bool(len(scene.actions)) for scene in scenes)
    assert len(data.scenes()) == loose
    assert len(data.finals()) == len(scenes) - loose
    assert len(data.scenes(1)) == 1
    (tmp_path / "broken.h5").write_bytes(path.read_bytes()[:2000])
    with pytest.raises(UserError, match=r"broken\.h5"):
        read_static_scenes(tmp_path / "broken.h5")


def test_samples_have_a_grasp_of_each_loose_tool():
    actions = np.zeros((5, 8))
    actions[:, 0] = (0, 0, 0, 1, 1)
    actions[:, 1] = (0.0, 0.5, 30.0, 0.2, 0.2)
    actions[:, 2] = np.linspace(0.3, 0.6, 5)
    scene = StaticScene.of(Observation(), actions)
    final = StaticScene.of(Observation(), np.zeros((0, 8)))
    samples = StaticSamples(StaticScenes(GRID, (final, scene)))
    # Samples are a proper sequence: negative indices count from the end, too large ones fail.
    assert (samples[-1].pick == samples[len(samples) - 1].pick).all()
    with pytest.raises(IndexError):
        samples[len(samples)]
    rows = GRID.to_pixel(actions[:, 2:4])[:, 0]
    seen = set()
    for index in range(len(samples)):
        sample = samples[index]
        assert len(sample.other_picks) == 1
        picks = {
            int(np.abs(rows - pick[0]).argmin()) for pick in (sample.pick, *sample.other_picks)
        }
        assert len(picks & {0, 1, 2}) == len(picks & {3, 4}) == 1
        seen |= picks
    # Samples use all grasps but the third, whose cost of 30 means that it would not hold.
    assert seen == {0, 1, 3, 4}
    np.testing.assert_array_equal(samples[3].pick, samples[3].pick)
