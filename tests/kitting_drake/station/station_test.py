import dataclasses
import gc
import shutil
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS, SCENARIOS
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.weights import load_networks
from kitting_drake.scenario import Scenario, load_scenario
from kitting_drake.scenario.policies import (
    Learned,
    Oracle,
    PolicyConfig,
    PythonPolicy,
    QuantizedOracle,
    ShapeMatching,
)
from kitting_drake.scenario.schema import Pinhole, Sleep
from kitting_drake.station import Cell, build_cell
from kitting_drake.tasks import Kitting
from kitting_drake.tasks.ravens.palletizing_boxes import PalletizingBoxes
from kitting_drake.tasks.task import TABLE
from systems.hand_geometry import JOINT_LIMITS
from systems.heightmap_projector import HeightmapProjector
from systems.placement import Placement
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import Observation, PickPlaceAction

BASE = Path(__file__).parent
BLIND = Scenario(cameras={})
TWINS = Scenario(task=Kitting(tools=["flat_screwdriver", "flat_screwdriver"]), cameras={})


def build(scenario: Scenario = BLIND) -> Cell:
    return build_cell(scenario, seed=0, base=BASE)


@pytest.fixture(scope="module")
def cell() -> Cell:
    """All memory is in the Context: one cell does for all."""
    return build()


def advance(
    cell: Cell, seconds: float, look: Callable[[Context], None] = lambda _: None
) -> Context:
    """Simulates, objects that rest falling asleep; `look` is called after every step."""
    simulator = Simulator(cell.diagram)

    def monitor(root: Context) -> EventStatus:
        cell.apply_sleep(root)
        look(root)
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    simulator.AdvanceTo(seconds)
    return simulator.get_context()


def port(cell: Cell, name: str, root: Context | None = None) -> Any:
    """What an exported output port says, at the beginning if nothing else is asked."""
    root = cell.diagram.CreateDefaultContext() if root is None else root
    return cell.diagram.GetOutputPort(name).Eval(root)


def locked(cell: Cell, root: Context) -> list[bool]:
    context = cell.plant.GetMyContextFromRoot(root)
    return [cell.plant.get_body(item.body).is_locked(context) for item in cell.objects]


def test_default_context_is_the_scene(cell: Cell):
    root = cell.diagram.CreateDefaultContext()
    for X_WB, item in zip(cell.object_poses(root), cell.scene.objects, strict=True):
        assert X_WB.IsNearlyEqualTo(item.X_WB, 1e-12)
    assert [item.name for item in cell.objects] == [item.name for item in cell.scene.objects]
    context = cell.plant.GetMyContextFromRoot(root)
    kit = cell.plant.GetBodyByName("kit").EvalPoseInWorld(context)
    assert kit.IsNearlyEqualTo(cell.scene.fixtures[0].X_WF, 1e-12)
    # The hand is where the planner wants it, at rest.
    hand = cell.plant.GetModelInstanceByName("franka_hand")
    home = Scenario().planner.home
    np.testing.assert_allclose(
        cell.plant.GetPositionsAndVelocities(context, hand), [*home, 0.04, 0.04, *np.zeros(6)]
    )


def test_the_hand_reaches_as_far_as_scenarios_are_told(cell: Cell):
    for name, limits in JOINT_LIMITS.items():
        joint = cell.plant.GetJointByName(name)
        found = (*joint.position_lower_limits(), *joint.position_upper_limits())
        assert found == pytest.approx(limits)


def test_the_table_is_where_tasks_have_it(cell: Cell):
    (geometry,) = cell.plant.GetCollisionGeometriesForBody(cell.plant.GetBodyByName("table"))
    inspector = cell.scene_graph.model_inspector()
    X_WTable = cell.plant.GetBodyByName("table").EvalPoseInWorld(
        cell.plant.GetMyContextFromRoot(cell.diagram.CreateDefaultContext())
    )
    middle = (X_WTable @ inspector.GetPoseInFrame(geometry)).translation()
    half_sizes = inspector.GetShape(geometry).size() / 2
    for corner, sign in zip(TABLE, (-1, 1), strict=True):
        np.testing.assert_allclose(corner, (middle + sign * half_sizes)[:2])
    assert middle[2] + half_sizes[2] == pytest.approx(0.0)


def test_nothing_touches_at_the_beginning_but_objects_the_table(cell: Cell):
    context = cell.plant.GetMyContextFromRoot(cell.diagram.CreateDefaultContext())
    results = cell.plant.get_contact_results_output_port().Eval(context)
    assert results.num_point_pair_contacts() == 0
    inspector = cell.scene_graph.model_inspector()
    table = {
        str(i) for i in cell.plant.GetCollisionGeometriesForBody(cell.plant.GetBodyByName("table"))
    }
    for i in range(results.num_hydroelastic_contacts()):
        surface = results.hydroelastic_contact_info(i).contact_surface()
        pair = {str(surface.id_M()), str(surface.id_N())}
        assert pair & table, [inspector.GetName(surface.id_M()), inspector.GetName(surface.id_N())]


@pytest.mark.parametrize("can_render", [True, False])
def test_exported_ports(
    can_render: bool, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
):
    if can_render:
        request.getfixturevalue("rendering")
    else:
        monkeypatch.setattr("kitting_drake.station.station.can_render", lambda: False)
    diagram = build(Scenario()).diagram
    errors = ["add_s", "position_error", "angle_error", "height_error"]
    sizes = {**dict.fromkeys(["success", *errors], 4), "reward": 1, "mode": 1, "counts": 3}
    names = [diagram.get_output_port(i).get_name() for i in range(diagram.num_output_ports())]
    observation = ["observation"] if can_render else []
    assert sorted(names) == sorted(["action", "placements", *sizes, *observation])
    assert diagram.num_input_ports() == 0
    context = diagram.CreateDefaultContext()
    for name, size in sizes.items():
        assert diagram.GetOutputPort(name).Eval(context).shape == (size,)
    assert isinstance(diagram.GetOutputPort("action").Eval(context), PickPlaceAction)
    placements = diagram.GetOutputPort("placements").Eval(context)
    assert [type(item) for item in placements] == [Placement] * 4


def test_the_oracle_begins_with_the_first_goal(cell: Cell):
    action = port(cell, "action")
    (grasp,) = cell.scene.objects[0].grasps
    expected = cell.scene.objects[0].X_WB @ np.array([grasp.x, grasp.y, 0.0])
    np.testing.assert_allclose([action.pick.x, action.pick.y], expected[:2], atol=1e-12)
    # It knows the heights, which nobody sees here.
    assert action.heights.pick_top == pytest.approx(grasp.surface_height)
    assert action.heights.place_rim == pytest.approx(Kitting().kit.height)


def test_a_quantized_oracle_says_pixels_and_bins(cell: Cell):
    exact = port(cell, "action")
    rounded = port(
        build(dataclasses.replace(BLIND, policy=QuantizedOracle(orientations=36))), "action"
    )
    grid = BLIND.heightmap.grid()
    pixel = grid.to_pixel((rounded.pick.x, rounded.pick.y))
    np.testing.assert_allclose(pixel, np.round(grid.to_pixel((exact.pick.x, exact.pick.y))))
    bins = np.rad2deg(rounded.pick.theta) / 10
    assert bins == pytest.approx(round(np.rad2deg(exact.pick.theta) / 10))


def test_scores_are_of_where_objects_are(cell: Cell):
    root = cell.diagram.CreateDefaultContext()
    assert port(cell, "reward", root) == [0.0]
    context = cell.plant.GetMyMutableContextFromRoot(root)
    for item, goal in list(zip(cell.objects, cell.scene.goals, strict=True))[:3]:
        cell.plant.SetFreeBodyPose(context, cell.plant.get_body(item.body), goal.poses[0])
    assert port(cell, "success", root).tolist() == [1.0, 1.0, 1.0, 0.0]
    assert port(cell, "reward", root) == pytest.approx([0.75])
    assert [item.success for item in cell.placements(root)] == [True] * 3 + [False]


def test_what_lies_still_goes_to_sleep(cell: Cell):
    asleep: list[list[bool]] = []
    at_rest: list[list[bool]] = []

    def look(root: Context) -> None:
        asleep.append(locked(cell, root))
        at_rest.append(cell.at_rest(root).tolist())

    root = advance(cell, 0.6, look)
    assert asleep == at_rest
    assert asleep[0] == [False] * 4
    assert asleep[-1] == [True] * 4
    # The contact of a sleeping object with table and kit is not computed.
    results = cell.plant.get_contact_results_output_port().Eval(
        cell.plant.GetMyContextFromRoot(root)
    )
    assert results.num_hydroelastic_contacts() == 0


def test_a_sleeping_stack_costs_nothing_and_wakes_together():
    cell = build(Scenario(task=PalletizingBoxes(layers=2), cameras={}))

    def contacts(root: Context) -> int:
        context = cell.plant.GetMyContextFromRoot(root)
        port = cell.plant.get_contact_results_output_port()
        return port.Eval(context).num_hydroelastic_contacts()

    counts: list[int] = []
    root = advance(cell, 0.6, lambda root: counts.append(contacts(root)))
    assert max(counts) == 12
    assert counts[-1] == 0
    assert all(locked(cell, root))
    # One that wakes touches those that still sleep: the highest box is the last.
    top = len(cell.objects) - 1
    detector = cell.rest_detector.GetMyMutableContextFromRoot(root)
    detector.get_mutable_discrete_state().get_mutable_vector(2).SetAtIndex(top, 0.0)
    cell.apply_sleep(root)
    assert locked(cell, root) == [True] * top + [False]
    Simulator(cell.diagram, root).AdvanceTo(root.get_time() + 0.01)
    assert contacts(root) == 1


def test_what_is_flung_out_of_the_cell_comes_to_rest(cell: Cell):
    """A free body that spins on and on overflows its quaternion in two seconds."""
    simulator = Simulator(cell.diagram)
    root = simulator.get_mutable_context()
    context = cell.plant.GetMyMutableContextFromRoot(root)
    # The oracle is busy with another meanwhile.
    flung = cell.plant.get_body(cell.objects[-1].body)
    velocity = SpatialVelocity([0, 0, 4000.0], [300.0, 200.0, 300.0])
    cell.plant.SetFreeBodySpatialVelocity(context, flung, velocity)

    def monitor(root: Context) -> EventStatus:
        cell.apply_sleep(root)
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    simulator.AdvanceTo(2.5)
    assert np.isfinite(cell.plant.GetPositions(context)).all()
    assert locked(cell, root)[-1]
    assert not port(cell, "placements", root)[-1].success


def test_sleep_can_be_switched_off():
    cell = build(dataclasses.replace(TWINS, sleep=Sleep(enabled=False)))
    asleep: list[list[bool]] = []
    root = advance(cell, 0.6, lambda root: asleep.append(locked(cell, root)))
    assert len(asleep) > 70
    assert not np.any(asleep)
    assert cell.at_rest(root).all()  # The rest detector says so nevertheless.


def test_two_runs_of_a_seed_are_equal_to_the_bit():
    """To the middle of the first grasp, with objects gone to sleep on the way."""

    def final_state() -> NDArray[np.float64]:
        cell = build(TWINS)
        root = advance(cell, 3.0)
        assert port(cell, "counts", root)[0] == 1
        context = cell.plant.GetMyContextFromRoot(root)
        return cell.plant.get_state_output_port().Eval(context).copy()

    np.testing.assert_array_equal(final_state(), final_state())


def test_twins_are_two_bodies_of_one_model():
    cell = build(TWINS)
    one, other = (cell.plant.get_body(item.body) for item in cell.objects)
    assert one.index() != other.index()
    assert one.model_instance() != other.model_instance()
    here, there = cell.object_poses(cell.diagram.CreateDefaultContext())
    assert np.linalg.norm(here.translation() - there.translation()) > 0.02


SMALL = {
    name: dataclasses.replace(camera, width=160, height=120, focal_length=112.5)
    for name, camera in Scenario().cameras.items()
    if isinstance(camera, Pinhole)
}


@pytest.mark.usefixtures("rendering")
def test_a_learned_policy_acts_upon_what_is_seen(weights_file: Path):
    told: list[Observation] = []
    cell = build_cell(
        Scenario(policy=Learned(weights=weights_file.name, orientations=36), cameras=SMALL),
        seed=0,
        base=weights_file.parent,
        observer=lambda observation, _: told.append(observation),
    )
    context = cell.diagram.CreateDefaultContext()
    observation = port(cell, "observation", context)
    assert observation.height.any()
    assert not told
    found = port(cell, "action", context)
    policy = LearnedPolicy(load_networks(weights_file, preferred_type()), orientations=36)
    assert found == policy(observation)
    (seen,) = told
    np.testing.assert_array_equal(seen.image, observation.image)
    # Nothing has changed: it is not asked again.
    assert port(cell, "action", context) == found
    assert len(told) == 1


@pytest.mark.parametrize(
    ("policy", "sight"),
    [
        (Oracle(), "heights"),
        (ShapeMatching(), "heights"),
        (Learned(), "heights"),
        (Learned(weights=str(MODELS / "policies" / "kitting_seen.safetensors")), "observation"),
        (PythonPolicy(function="systems.signals:PickPlaceAction"), "observation"),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_colours_are_rendered_only_for_who_sees_them(policy: PolicyConfig, sight: str):
    cell = build(Scenario(policy=policy, cameras=SMALL))
    (projector,) = (
        system for system in cell.diagram.GetSystems() if isinstance(system, HeightmapProjector)
    )
    lookers = [cell.planner.GetInputPort("observation")]
    looks = cell.diagram.GetSubsystemByName("policy")
    if looks.HasInputPort("observation"):
        lookers.append(looks.GetInputPort("observation"))
    for looker in lookers:
        assert cell.diagram.AreConnected(projector.GetOutputPort(sight), looker)


@pytest.mark.usefixtures("rendering")
def test_who_watches_is_shown_colours():
    told: list[Observation] = []
    cell = build_cell(
        Scenario(policy=Learned(), cameras=SMALL),
        seed=0,
        base=BASE,
        observer=lambda observation, _: told.append(observation),
    )
    port(cell, "action")
    assert told[0].rgb.any()


def test_a_policy_that_looks_needs_cameras_and_rendering(monkeypatch: pytest.MonkeyPatch):
    looks = PythonPolicy(function="systems.signals:PickPlaceAction")
    with pytest.raises(UserError, match="cameras is empty"):
        build(dataclasses.replace(BLIND, policy=looks))
    monkeypatch.setattr("kitting_drake.common.rendering.can_render", lambda: False)
    with pytest.raises(UserError, match="rendering needs the system library libEGL"):
        build(Scenario(policy=looks))


@pytest.mark.parametrize("name", ["OneOfEverything", "OneOfEverythingElse", "OneOfEverythingDrawn"])
@pytest.mark.usefixtures("rendering")
def test_one_of_everything_builds_and_steps(name: str):
    scenario = load_scenario(BASE.parent / "scenario" / "test_scenarios.yaml", name)
    cell = build(scenario)
    assert cell.diagram.HasOutputPort("observation")
    assert cell.plant.time_step() == scenario.plant.time_step
    assert cell.sleep == scenario.sleep.enabled
    root = advance(cell, 0.1)
    observation = port(cell, "observation", root)
    assert observation.grid == scenario.heightmap.grid()
    assert observation.height.any()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{heightmap: {z_max: 0.03}}", r"z_max is 0\.03, and the hand would not see how high"),
        ("{planner: {open_width: 0.01}}", r"open_width is 0\.01, and .* wide where it is gripped"),
        (
            "{heightmap: {z_min: -0.03}, policy: !Learned {weights: ''}}",
            r"z_min is -0\.03, and the policy of generalist\.safetensors learned from heights",
        ),
        (
            "{task: !StackBlockPyramid {}, policy: !Learned {weights: '', recover: true}}",
            r"policy\.recover mends insertions",
        ),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_what_would_go_wrong_is_not_built(text: str, sentence: str):
    scenario = load_scenario(SCENARIOS / "kitting_seen.yaml", text=text)
    with pytest.raises(UserError, match=sentence):
        build(scenario)


# Models that cannot be used.


@pytest.fixture
def own_tool(tmp_path: Path) -> Path:
    """A tool's folder that may be spoilt, whose model refers to its own meshes."""
    folder = Path(shutil.copytree(MODELS / "tools" / "flat_screwdriver", tmp_path / "mine"))
    sdf = folder / "flat_screwdriver.sdf"
    package = "package://kitting_models/tools/flat_screwdriver/"
    sdf.write_text(sdf.read_text().replace(package, ""))
    return folder


def with_tool(folder: Path) -> Scenario:
    return dataclasses.replace(BLIND, task=Kitting(tools=[str(folder)]))


def test_a_tool_of_ones_own(own_tool: Path):
    cell = build(with_tool(own_tool))
    body = cell.plant.get_body(cell.objects[0].body)
    assert len(cell.plant.GetCollisionGeometriesForBody(body)) == 6


@pytest.mark.parametrize("spoilt", ["collision_0.obj", "flat_screwdriver.sdf"])
def test_a_model_that_cannot_be_parsed_is_the_users_to_repair(own_tool: Path, spoilt: str):
    if spoilt.endswith(".obj"):
        (own_tool / spoilt).unlink()
    else:
        (own_tool / spoilt).write_text("<sdf")
    with pytest.raises(UserError, match=spoilt):
        build(with_tool(own_tool))


def test_a_mesh_that_is_none_is_the_users_to_repair(own_tool: Path):
    for name in ("red_grip.obj", "black_rubber.obj", "polished_steel.obj"):
        (own_tool / name).write_text("not a mesh\n")
    with pytest.raises(UserError, match="obj"):
        build(with_tool(own_tool))


@pytest.mark.parametrize(
    "policy", [Oracle(), PythonPolicy(function="systems.signals:PickPlaceAction")]
)
@pytest.mark.usefixtures("rendering", "freed_diagrams")
def test_a_cell_that_nobody_uses_leaves_the_memory(policy: PolicyConfig):
    """A loop that builds cell after cell does not grow."""
    scenario = Scenario(policy=policy, sensor_noise=SensorNoiseParameters(depth_std=0.001))
    cell = build(scenario)
    simulator = Simulator(cell.diagram)
    simulator.AdvanceTo(0.01)
    diagram = weakref.ref(cell.diagram)
    del cell, simulator
    gc.collect()
    assert diagram() is None
