import dataclasses
import shutil
import sys
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from kitting_drake.cell.cell import Cell, build_cell, make_grid
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.episode.episode import EpisodeResult, run_episode
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.weights import load_networks, preferred_type
from kitting_drake.scenario.schema import (
    ArrangedKitting,
    Kitting,
    Learned,
    Pinhole,
    Placement,
    PythonPolicy,
    QuantisedOracle,
    Scenario,
    Sleep,
    load_scenario,
)
from kitting_drake.tasks.kitting.scene import TABLE
from systems.pick_place_parameters import Mode
from systems.signals import Observation, PickPlaceAction, PlanarPose

BASE = Path(__file__).parent
SCORES = ["add_s", "position_error", "angle_error", "height_error"]


def build(scenario: Scenario | None = None, seed: int = 0) -> Cell:
    return build_cell(scenario or Scenario(), seed=seed, base=BASE)


def run(
    cell: Cell, seconds: float, watch: Callable[[Context, Mode], None] | None = None
) -> EpisodeResult:
    return run_episode(
        cell, scenario="test", policy="test", seed=0, time_limit=seconds, watch=watch
    )


def final_state(cell: Cell, seconds: float) -> tuple[EpisodeResult, NDArray]:
    """The result of an episode, and the plant's state at its last step."""
    states: list[NDArray] = []

    def watch(root: Context, _: Mode) -> None:
        states[:] = [
            cell.plant.get_state_output_port().Eval(cell.plant.GetMyContextFromRoot(root)).copy()
        ]

    return run(cell, seconds, watch), states[0]


def tool_poses(cell: Cell, root: Context) -> list[RigidTransform]:
    context = cell.plant.GetMyContextFromRoot(root)
    return [body.EvalPoseInWorld(context) for body in cell.tool_bodies]


def test_default_context_is_the_scene():
    cell = build(seed=2)
    root = cell.diagram.CreateDefaultContext()
    for X_WT, expected in zip(tool_poses(cell, root), cell.scene.X_WTools, strict=True):
        assert X_WT.IsNearlyEqualTo(expected, 1e-12)
    context = cell.plant.GetMyContextFromRoot(root)
    kit = cell.plant.GetBodyByName("kit").EvalPoseInWorld(context)
    assert kit.IsNearlyEqualTo(cell.scene.X_WKit, 1e-12)
    # The hand is where the planner wants it, at rest.
    hand = cell.plant.GetModelInstanceByName("franka_hand")
    home = Scenario().planner.home
    np.testing.assert_allclose(
        cell.plant.GetPositionsAndVelocities(context, hand), [*home, 0.04, 0.04, *np.zeros(6)]
    )


def test_the_table_is_where_the_task_has_it():
    cell = build()
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


def test_nothing_touches_at_the_beginning_but_tools_the_table():
    cell = build(seed=2)
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
        monkeypatch.setattr("kitting_drake.cell.cell.can_render", lambda: False)
    diagram = build().diagram
    sizes = {**dict.fromkeys(SCORES, 4), "mode": 1, "counts": 3}
    names = [diagram.get_output_port(i).get_name() for i in range(diagram.num_output_ports())]
    observation = ["observation"] if can_render else []
    assert sorted(names) == sorted(["action", *sizes, *observation])
    assert diagram.num_input_ports() == 0
    context = diagram.CreateDefaultContext()
    for name, size in sizes.items():
        assert diagram.GetOutputPort(name).Eval(context).shape == (size,)
    assert isinstance(diagram.GetOutputPort("action").Eval(context), PickPlaceAction)


def test_the_oracle_begins_with_the_first_tool():
    cell = build()
    action = cell.diagram.GetOutputPort("action").Eval(cell.diagram.CreateDefaultContext())
    grasp = cell.scene.tools[0].grasp
    expected = cell.scene.X_WTools[0] @ np.array([grasp.x, grasp.y, 0.0])
    np.testing.assert_allclose([action.pick.x, action.pick.y], expected[:2], atol=1e-12)
    assert action.surface_height == pytest.approx(grasp.surface_height)


def test_a_quantised_oracle_answers_in_pixels_and_bins():
    exact, rounded = (
        cell.diagram.GetOutputPort("action").Eval(cell.diagram.CreateDefaultContext())
        for cell in (build(), build(Scenario(policy=QuantisedOracle(orientations=36))))
    )
    grid = make_grid(Scenario().heightmap)
    pixel = grid.to_pixel((rounded.pick.x, rounded.pick.y))
    np.testing.assert_allclose(pixel, np.round(grid.to_pixel((exact.pick.x, exact.pick.y))))
    bins = np.rad2deg(rounded.pick.theta) / 10
    assert bins == pytest.approx(round(np.rad2deg(exact.pick.theta) / 10))


def test_what_lies_still_goes_to_sleep():
    cell = build()
    locked: list[list[bool]] = []

    def watch(root: Context, _: Mode) -> None:
        at_rest = cell.rest_detector.at_rest(cell.rest_detector.GetMyContextFromRoot(root))
        context = cell.plant.GetMyContextFromRoot(root)
        locked.append([body.is_locked(context) for body in cell.tool_bodies])
        assert locked[-1] == at_rest.tolist()

    run(cell, 0.6, watch)
    assert locked[0] == [False] * 4
    assert locked[-1] == [True] * 4


def test_sleep_can_be_switched_off():
    cell = build(Scenario(sleep=Sleep(enabled=False)))

    def watch(root: Context, _: Mode) -> None:
        context = cell.plant.GetMyContextFromRoot(root)
        assert not any(body.is_locked(context) for body in cell.tool_bodies)

    run(cell, 0.6, watch)


def test_two_runs_of_a_seed_are_equal_to_the_bit():
    """To the middle of the first grasp, with tools gone to sleep on the way."""
    (first, one), (second, other) = (final_state(build(), 3.0) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert first.actions == 1
    assert first.point_contact_pairs == 0
    assert dataclasses.replace(first, wall_seconds=0) == dataclasses.replace(second, wall_seconds=0)


def test_a_simulation_that_fails_ends_the_episode_with_its_reason():
    cell = build()

    def watch(root: Context, _: Mode) -> None:
        if root.get_time() > 0.05:
            raise RuntimeError("the solver did\nnot converge")

    result = run(cell, 1.0, watch)
    assert result.failure is not None
    assert "the solver did not converge" in result.failure
    assert result.success_rate == 0.0
    assert not result.interrupted
    assert len(result.objects) == 4
    assert 0.05 < result.sim_seconds < 0.1
    # Plain numbers, of which JSON can be made.
    kinds = {type(value) for item in result.objects for value in vars(item).values()}
    assert kinds == {str, float, bool}


def test_an_interrupted_episode_has_a_result():
    cell = build()

    def watch(root: Context, _: Mode) -> None:
        if root.get_time() > 0.05:
            raise KeyboardInterrupt

    result = run(cell, 1.0, watch)
    assert result.interrupted
    assert result.failure is None
    assert 0.05 < result.sim_seconds < 0.1


# Policies that look.

SMALL = {
    name: dataclasses.replace(camera, width=160, height=120, focal_length=112.5)
    for name, camera in Scenario().cameras.items()
    if isinstance(camera, Pinhole)
}


class Stub:
    """A policy that sends the hand to where nothing lies, then stops."""

    def __init__(self) -> None:
        self.seen: list[Observation] = []

    def __call__(self, observation: Observation) -> PickPlaceAction:
        self.seen.append(observation)
        nothing = PlanarPose(0.3, 0.45, 0.0)
        return PickPlaceAction(nothing, nothing, 0.06, stop=len(self.seen) == 2)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    """A policy that a scenario may import as `stub_policy:policy`."""
    policy = Stub()
    module = types.SimpleNamespace(policy=policy, number=3)
    monkeypatch.setitem(sys.modules, "stub_policy", module)
    return policy


@pytest.mark.usefixtures("rendering")
def test_a_python_policy_is_asked_only_when_the_planner_has_observed(stub: Stub):
    scenario = Scenario(
        task=ArrangedKitting(
            tools={"claw_hammer": Placement(x=0.35, y=-0.3)}, kit_pose=Placement(x=0.55, y=0.0)
        ),
        policy=PythonPolicy(function="stub_policy:policy"),
        cameras=SMALL,
    )
    cell = build(scenario)
    diagram = cell.diagram
    assert diagram.HasOutputPort("observation")
    asked: list[Mode] = []
    before = Mode.OBSERVE

    def watch(_: Context, mode: Mode) -> None:
        nonlocal before
        if len(stub.seen) > len(asked):
            asked.append(before)
            assert mode in (Mode.APPROACH, Mode.DONE)
        before = mode

    result = run(cell, 30.0, watch)
    assert asked == [Mode.OBSERVE, Mode.OBSERVE]
    assert (result.actions, result.missed_grasps) == (1, 1)
    assert [action.outcome for action in result.actions_taken] == ["missed"]
    assert result.objects[0].cause == "missed grasp"
    assert result.failure is None
    # It was shown the block, 50 mm high, where it stands, and not the hand.
    seen = stub.seen[1]
    row, col = np.round(seen.grid.to_pixel([0.45, 0.08])).astype(int)
    block = seen.height[row - 8 : row + 9, col - 8 : col + 9]
    assert np.count_nonzero(block) > 20  # These small images do not reach every pixel.
    np.testing.assert_allclose(block[block > 0], 0.05, atol=0.004)
    assert seen.height.max() < 0.07


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("no_such_module:policy", "policy.function: cannot import no_such_module:policy"),
        ("stub_policy:missing", "policy.function: cannot import stub_policy:missing"),
        ("stub_policy:number", "policy.function: stub_policy:number is not a function"),
    ],
)
@pytest.mark.usefixtures("stub", "rendering")
def test_a_policy_that_cannot_be_had_is_named(function: str, message: str):
    with pytest.raises(UserError, match=message):
        build(Scenario(policy=PythonPolicy(function=function)))


@pytest.mark.usefixtures("rendering")
def test_a_policy_that_fails_ends_the_episode_with_its_reason(monkeypatch: pytest.MonkeyPatch):
    def fail(_: Observation) -> PickPlaceAction:
        raise ValueError("weights of the wrong shape")

    module = types.SimpleNamespace(policy=fail)
    monkeypatch.setitem(sys.modules, "stub_policy", module)
    cell = build(Scenario(policy=PythonPolicy(function="stub_policy:policy"), cameras=SMALL))
    assert "weights of the wrong shape" in str(run(cell, 1.0).failure)


@pytest.mark.usefixtures("rendering")
def test_a_learned_policy_answers_what_it_sees(weights_file: Path):
    told: list[Observation] = []
    cell = build_cell(
        Scenario(policy=Learned(weights=weights_file.name, orientations=36), cameras=SMALL),
        seed=0,
        base=weights_file.parent,
        watch=lambda observation, _: told.append(observation),
    )
    context = cell.diagram.CreateDefaultContext()
    observation = cell.diagram.GetOutputPort("observation").Eval(context)
    assert observation.height.any()
    assert not told
    found = cell.diagram.GetOutputPort("action").Eval(context)
    policy = LearnedPolicy(load_networks(weights_file, preferred_type()), orientations=36)
    assert found == policy(observation)
    (seen,) = told
    np.testing.assert_array_equal(seen.image, observation.image)
    # Nothing has changed: it is not asked again.
    assert cell.diagram.GetOutputPort("action").Eval(context) == found
    assert len(told) == 1


@pytest.mark.parametrize("name", ["OneOfEverything", "OneOfEverythingElse"])
@pytest.mark.usefixtures("rendering")
def test_one_of_everything_builds_and_steps(name: str):
    scenario = load_scenario(BASE.parent / "scenario" / "test_scenarios.yaml", name)
    cell = build(scenario)
    assert cell.diagram.HasOutputPort("observation")
    assert cell.plant.time_step() == scenario.plant.time_step
    assert cell.sleep == scenario.sleep.enabled
    simulator = Simulator(cell.diagram)
    simulator.AdvanceTo(0.1)
    observation = cell.diagram.GetOutputPort("observation").Eval(simulator.get_context())
    assert observation.grid.rows == scenario.heightmap.rows
    assert observation.height.any()


# Models that cannot be used.


@pytest.fixture
def own_tool(tmp_path: Path) -> Path:
    """A tool's folder that may be spoilt, whose model refers to its own meshes."""
    folder = Path(shutil.copytree(MODELS / "tools" / "flat_screwdriver", tmp_path / "mine"))
    sdf = folder / "flat_screwdriver.sdf"
    package = "package://kitting_models/tools/flat_screwdriver/"
    sdf.write_text(sdf.read_text().replace(package, ""))
    return folder


def test_a_tool_of_ones_own(own_tool: Path):
    cell = build(Scenario(task=Kitting(tools=[str(own_tool)])))
    assert len(cell.plant.GetCollisionGeometriesForBody(cell.tool_bodies[0])) == 6


@pytest.mark.parametrize("spoilt", ["collision_0.obj", "flat_screwdriver.sdf"])
def test_a_model_that_cannot_be_parsed_is_the_users_to_mend(own_tool: Path, spoilt: str):
    if spoilt.endswith(".obj"):
        (own_tool / spoilt).unlink()
    else:
        (own_tool / spoilt).write_text("<sdf")
    with pytest.raises(UserError, match=spoilt):
        build(Scenario(task=Kitting(tools=[str(own_tool)])))


def test_a_mesh_that_is_none_is_the_users_to_mend(own_tool: Path):
    for name in ("red_grip.obj", "black_rubber.obj", "polished_steel.obj"):
        (own_tool / name).write_text("not a mesh\n")
    with pytest.raises(UserError, match="obj"):
        build(Scenario(task=Kitting(tools=[str(own_tool)])))
