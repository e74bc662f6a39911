"""Collision geometry for tight cavities is accurate, and a tool goes in only if it fits."""

import dataclasses
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    ExternallyAppliedSpatialForce,
    MultibodyPlantConfig,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.common.sdformat import model_text
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.fine_hulls import fine_hulls, plan_deviation
from kitting_drake.hkd.tools.fine_tool import fine_tool
from kitting_drake.hkd.tools.scaling import scaled_tool
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.tasks.kitting.kitting import Kitting

_CLOSING = KitParameters().closing_radius


def hulls_of(tool: Tool) -> list[np.ndarray]:
    """The collision hulls of a tool's model, as points in mm."""
    found = []
    for mesh in ElementTree.parse(tool.sdf).getroot().findall(".//collision/geometry/mesh"):
        scale = float((mesh.findtext("scale") or "1").split()[0])
        found.append(1e3 * scale * np.asarray(trimesh.load_mesh(mesh.findtext("uri")).vertices))
    return found


@pytest.mark.parametrize(
    "tool",
    [
        pytest.param(lambda: load_tool("flat_screwdriver"), id="screwdriver"),
        pytest.param(
            lambda: load_tool("stubby_combination_wrench"), id="wrench", marks=pytest.mark.slow
        ),
        pytest.param(lambda: scaled_tool(load_tool("tin_snips"), 0.3), id="scaled"),
        pytest.param(lambda: load_named("bracket_60x36x12"), id="part"),
    ],
)
def test_the_outline_is_within_a_twentieth_of_a_millimetre(tool):
    tool = tool()
    hulls = hulls_of(fine_tool(tool, _CLOSING))
    outside, inside = plan_deviation(hulls, tool.footprint.scale((1e3, 1e3)))
    assert outside < 0.03
    assert inside < 0.05
    points = np.vstack(hulls)
    assert points[:, 2].min() == pytest.approx(0.0, abs=0.03)
    assert points[:, 2].max() == pytest.approx(1e3 * tool.height, abs=0.25)


def test_a_bolt_keeps_its_shank():
    bolt = load_named("bolt_30x10")
    hulls = fine_hulls([1e3 * triangles for _, triangles in bolt.parts])
    above = np.vstack([hull for hull in hulls if hull[:, 2].max() > 20.0])
    assert np.ptp(above[above[:, 2] > 15.0][:, 0]) < 10.5
    assert len(hulls) > 1


def test_an_open_surface_is_refused(tmp_path):
    tool = load_tool("flat_screwdriver")
    mesh = tmp_path / "steel.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(UserError, match="not closed"):
        fine_tool(dataclasses.replace(tool, visual_meshes=(mesh,)), _CLOSING)


def test_default_clearances_keep_the_tools_as_they_are():
    tools = [load_tool("flat_screwdriver")]
    assert Kitting().fitted(tools)[0] is tools[0]
    assert Kitting(kit=KitParameters(clearance=0.001)).fitted(tools)[0] is tools[0]
    tight = Kitting(kit=KitParameters(clearance=0.0009)).fitted(tools)[0]
    assert tight.sdf != tools[0].sdf
    assert tight.footprint.area() == tools[0].footprint.area()


def _height(clearance: float) -> float:
    """How far a tool is above its seat, in mm, once pressed down with 20 N."""
    tool = load_tool("flat_screwdriver")
    parameters = KitParameters(clearance=clearance).with_fine_walls()
    kit = make_kit([tool], parameters)
    moving = fine_tool(tool, parameters.closing_radius)
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=1 / 128, contact_model="hydroelastic", discrete_contact_approximation="lagged"
    )
    plant, _ = AddMultibodyPlant(config, builder)
    for sdf in (kit.sdf, moving.sdf):
        Parser(plant).AddModelsFromString(model_text(sdf), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("kit"))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    body, pose = plant.GetBodyByName("tool"), kit.goal(0)
    start = pose.z + tool.height + 0.0001
    plant.SetFreeBodyPose(own, body, RigidTransform([pose.x, pose.y, start]))
    force = ExternallyAppliedSpatialForce()
    force.body_index = body.index()
    force.p_BoBq_B = body.CalcCenterOfMassInBodyFrame(own)
    simulator = Simulator(diagram, context)
    for step in range(1, 65):
        force.F_Bq_W = SpatialForce([0, 0, 0], [0, 0, -20.0 * max(0, step - 32) / 32])
        plant.get_applied_spatial_force_input_port().FixValue(own, [force])
        simulator.AdvanceTo(step / 128)
    z = plant.EvalBodyPoseInWorld(own, body).translation()[2]
    return 1e3 * float(z - pose.z)


def test_a_tool_goes_into_a_tight_cavity_but_not_into_one_that_is_too_small():
    assert abs(_height(0.0003)) < 0.1
    assert _height(-0.0001) > 5.0
