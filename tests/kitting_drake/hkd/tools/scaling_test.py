import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Convex, Role
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tools.scaling import scaled_sdf, scaled_tool, weighted_tool
from kitting_drake.hkd.tools.tool import Tool, load_tool


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sets an empty cache; returns its folder of scaled tools."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "kitting_drake" / "tools"


def loaded(tool: Tool):
    """The tool's body, and the shapes and properties of its collision geometry."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModels(str(tool.sdf))
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    body = plant.GetBodyByName("tool")
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    geometries = [inspector.GetShape(g) for g in inspector.GetGeometries(frame, Role.kProximity)]
    properties = [
        inspector.GetProximityProperties(g) for g in inspector.GetGeometries(frame, Role.kProximity)
    ]
    return body, geometries, properties


@pytest.mark.parametrize("name", ["claw_hammer", "stubby_screwdriver"])
@pytest.mark.parametrize("length", [0.1551, 0.1937])
def test_lengths_mass_and_inertia_scale(name: str, length: float, cache: Path):
    tool = load_tool(name)
    scaled = scaled_tool(tool, length)
    s = length / tool.length
    assert scaled.sdf.is_relative_to(cache)
    assert (scaled.name, scaled.category, scaled.split) == (tool.name, tool.category, tool.split)
    assert scaled.mass == pytest.approx(s**3 * tool.mass)
    for key in ("x", "y", "width", "surface_height"):
        assert getattr(scaled.grasp, key) == pytest.approx(s * getattr(tool.grasp, key))
    assert scaled.grasp.theta == tool.grasp.theta
    extents = np.ptp(scaled.triangles.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(extents, s * np.ptp(tool.triangles.reshape(-1, 3), axis=0))
    np.testing.assert_allclose(
        extents, [scaled.length, scaled.width, scaled.height], rtol=0, atol=3e-4
    )
    np.testing.assert_allclose(scaled.surface_points(50), s * tool.surface_points(50))

    (old, old_shapes, _), (new, new_shapes, properties) = loaded(tool), loaded(scaled)
    assert new.default_mass() == pytest.approx(s**3 * old.default_mass())
    old_inertia, new_inertia = (b.default_spatial_inertia() for b in (old, new))
    np.testing.assert_allclose(new_inertia.get_com(), s * old_inertia.get_com(), rtol=1e-8)
    np.testing.assert_allclose(
        new_inertia.CalcRotationalInertia().CopyToFullMatrix3(),
        s**5 * old_inertia.CalcRotationalInertia().CopyToFullMatrix3(),
        rtol=1e-6,
        atol=1e-12,
    )
    assert len(new_shapes) == len(old_shapes)
    for old_shape, new_shape, proximity in zip(old_shapes, new_shapes, properties, strict=True):
        assert isinstance(new_shape, Convex)
        assert proximity.HasGroup("hydroelastic")
        assert proximity.HasProperty("hydroelastic", "hydroelastic_modulus")
        np.testing.assert_allclose(
            hull_extents(new_shape), s * hull_extents(old_shape), rtol=1e-9, atol=1e-12
        )


def hull_extents(shape: Convex) -> np.ndarray:
    hull = shape.GetConvexHull()
    vertices = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    return np.ptp(vertices, axis=0)


def test_a_tool_of_the_same_length_is_returned_unchanged(cache: Path):
    tool = load_tool("claw_hammer")
    assert scaled_tool(tool, tool.length + 5e-10) is tool
    assert not cache.exists()


def test_scaling_twice_equals_scaling_once(cache: Path):
    tool = load_tool("claw_hammer")
    twice = scaled_tool(scaled_tool(tool, 0.15), 0.19)
    assert twice.scale == pytest.approx(0.19 / tool.length)
    np.testing.assert_allclose(
        loaded(twice)[0].default_mass(), loaded(scaled_tool(tool, 0.19))[0].default_mass()
    )
    np.testing.assert_allclose(
        hull_extents(loaded(twice)[1][0]), hull_extents(loaded(scaled_tool(tool, 0.19))[1][0])
    )


@pytest.mark.parametrize("length", [0.0, -0.1, float("nan"), float("inf")])
def test_an_invalid_length_is_rejected(length: float, cache: Path):
    with pytest.raises(UserError, match="claw_hammer"):
        scaled_tool(load_tool("claw_hammer"), length)


def test_geometry_other_than_meshes_is_rejected():
    text = "<sdf><geometry><box><size>1 1 1</size></box></geometry></sdf>"
    with pytest.raises(ValueError, match="mesh"):
        scaled_sdf(text, Path(), 2.0)


def test_concurrent_scalings_of_the_same_tool_all_succeed(cache: Path):
    tool, both = load_tool("claw_hammer"), threading.Barrier(4)

    def scale(_: int) -> Tool:
        both.wait(timeout=60)
        return scaled_tool(tool, 0.1612)

    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(scale, range(4)))
    assert len({one.sdf for one in made}) == 1
    assert list(cache.iterdir()) == [made[0].directory]


def test_a_heavier_tool_has_scaled_inertia_and_stiffness(cache: Path):
    tool = load_tool("claw_hammer")
    heavy = weighted_tool(scaled_tool(tool, 0.19), 2.0)
    (old, _, before), (new, _, after) = loaded(scaled_tool(tool, 0.19)), loaded(heavy)
    factor = 2.0 / old.default_mass()
    assert new.default_mass() == pytest.approx(heavy.mass, rel=1e-5)
    inertias = [body.default_spatial_inertia().CopyToFullMatrix6() for body in (old, new)]
    np.testing.assert_allclose(inertias[1], factor * inertias[0], rtol=1e-5, atol=1e-9)
    moduli = [
        properties[0].GetProperty("hydroelastic", "hydroelastic_modulus")
        for properties in (before, after)
    ]
    assert moduli[1] == pytest.approx(factor * moduli[0], rel=1e-5)
    assert weighted_tool(tool, tool.mass) is tool
    with pytest.raises(UserError, match="cannot have a mass"):
        weighted_tool(tool, 0.0)


def test_a_heavy_tool_is_first_gripped_where_it_does_not_turn(cache: Path):
    tool = load_tool("combination_wrench")
    far = dataclasses.replace(tool.grasp, x=tool.grasp.x + 0.05)
    tool = dataclasses.replace(tool, grasp=far, other_grasps=(tool.grasp,))
    assert weighted_tool(tool, 0.15).grasps == tool.grasps
    assert weighted_tool(tool, 2.0).grasps == tool.grasps[::-1]
