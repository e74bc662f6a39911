import numpy as np
import pytest
import yaml
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.grasps.holds import WIDEST
from kitting_drake.hkd.grasps.proposals import propose_grasps
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.hkd.tools.tool import load_tool
from systems.grasp import Grasp
from systems.pick_place_parameters import PickPlaceParameters


def bar(length: float, width: float, height: float) -> Manifold:
    """A bar on the table along x, centred at the origin, in mm."""
    return Manifold.cube((length, width, height), True).translate((0, 0, height / 2))


def triangles(solid: Manifold) -> NDArray[np.float64]:
    vertices, faces = vertices_and_faces(solid)
    return 1e-3 * vertices[faces]


def test_a_bar_is_gripped_across_at_its_centre_of_mass():
    best = propose_grasps(triangles(bar(160, 18, 12)), np.zeros(3))[0]
    assert isinstance(best, Grasp)
    assert (best.x, best.y) == pytest.approx((0, 0), abs=1e-3)
    assert best.theta == pytest.approx(0, abs=1e-6)
    assert best.width == pytest.approx(0.018, abs=1e-6)
    assert best.surface_height == pytest.approx(0.012, abs=1e-9)
    assert best.contact == 1.0 and best.overhang == pytest.approx(0, abs=1e-9)
    assert best.cost == pytest.approx(sum(best.penalties.values()))


def test_the_pads_stay_above_a_broad_foot_and_the_table():
    """A bar on a broad foot: the pads clear the foot only if the grasp is shallow."""
    solid = bar(160, 70, 8) + bar(160, 18, 24)
    assert propose_grasps(triangles(solid), np.zeros(3))[0].width == pytest.approx(0.018, abs=1e-6)
    deep = PickPlaceParameters(grasp_depth=0.020)
    assert propose_grasps(triangles(solid), np.zeros(3), deep) == []
    # Grasps that would touch the table are not proposed either.
    high = PickPlaceParameters(floor_clearance=0.030)
    assert propose_grasps(triangles(bar(160, 18, 12)), np.zeros(3), high) == []


@pytest.mark.parametrize(
    "turn_deg", [-70.0, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (33.0, 90.0))]
)
def test_the_grasp_turns_with_the_bar(turn_deg: float):
    solid = bar(160, 18, 12).rotate((0, 0, turn_deg)).translate((7, -4, 0))
    best = propose_grasps(triangles(solid), np.array([0.007, -0.004]))[0]
    turn = np.radians(turn_deg) - best.theta
    assert (turn + np.pi / 2) % np.pi - np.pi / 2 == pytest.approx(0, abs=np.radians(0.6))
    assert (best.x, best.y) == pytest.approx((0.007, -0.004), abs=2e-3)
    assert best.width == pytest.approx(0.018, abs=4e-4)


def test_grasps_near_the_centre_of_mass_rank_first():
    proposals = propose_grasps(triangles(bar(160, 18, 12)), np.array([0.04, 0.0, 0.006]))
    assert proposals[0].x == pytest.approx(0.04, abs=1e-3)
    costs = [proposal.cost for proposal in proposals]
    assert costs == sorted(costs)


def test_grasps_avoid_collisions_of_the_upper_fingers():
    # Two beads beside a narrow neck: the pads would fit between them, but the fingers would not.
    beads = [bar(30, 34, 12).translate((side * 25.0, 0, 0)) for side in (-1, 1)]
    solid = bar(160, 14, 12) + beads[0] + beads[1]
    best = propose_grasps(triangles(solid), np.zeros(3))[0]
    assert 0.015 < abs(best.x) < 0.035
    assert best.width == pytest.approx(0.034, abs=1e-3)


def test_a_grasp_on_a_stepped_bar_is_centred_between_the_gripped_faces():
    solid = bar(80, 14, 12).translate((40, 5, 0)) + bar(80, 24, 12).translate((-40, 0, 0))
    best = propose_grasps(triangles(solid), np.array([0.045, 0.004]))[0]
    assert best.x > 0.011
    assert best.y == pytest.approx(0.005, abs=5e-4)


def test_the_surface_height_is_that_at_the_grasp():
    head = bar(20, 60, 30).translate((70, 0, 0))
    best = propose_grasps(triangles(bar(160, 18, 12) + head), np.array([0.02, 0.0]))[0]
    assert best.surface_height == pytest.approx(0.012, abs=1e-9)


@pytest.mark.parametrize(
    "solid",
    [
        bar(90, 90, 20),
        bar(160, 2, 12),
        bar(160, 20, 1),
        Manifold.cylinder(20, 45, circular_segments=96),
        # A pyramid has no upright faces.
        Manifold.cylinder(30, 30, 0.1, circular_segments=4),
        # The pads only reach the upper part of a thick log, where it narrows.
        CrossSection.circle(30, 96).extrude(160).rotate((0, 90, 0)).translate((-80, 0, 30)),
    ],
    ids=["too wide", "too narrow", "too flat", "disc", "pyramid", "log"],
)
def test_a_shape_that_cannot_be_held_has_no_grasp(solid: Manifold):
    assert propose_grasps(triangles(solid), np.zeros(3)) == []


def test_a_degenerate_mesh_has_no_grasp():
    assert propose_grasps(np.zeros((1, 3, 3)), np.zeros(3)) == []


@pytest.mark.parametrize(
    "name",
    [
        "claw_hammer",
        pytest.param("slip_joint_pliers", marks=pytest.mark.slow),
        pytest.param("combination_wrench", marks=pytest.mark.slow),
        pytest.param("flat_screwdriver", marks=pytest.mark.slow),
    ],
)
def test_the_best_grasp_is_near_the_annotated_one(name: str):
    tool = load_tool(name)
    record = yaml.safe_load((tool.directory / "tool.yaml").read_text())
    surface = tool.triangles
    best = propose_grasps(surface, np.array(record["center_of_mass"]))[0]
    assert np.hypot(best.x - tool.grasp.x, best.y - tool.grasp.y) < 0.015
    assert abs(best.theta - tool.grasp.theta) < np.radians(6)
    assert best.width < WIDEST
