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
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS, SCENARIOS
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.weights import load_networks
from kitting_drake.policies.stages import make_stages
from kitting_drake.scenario import Scenario, load_scenario
from kitting_drake.scenario.cameras import Pinhole
from kitting_drake.scenario.policies import (
    Learned,
    Oracle,
    PolicyConfig,
    PythonPolicy,
    QuantizedOracle,
    ShapeMatching,
)
from kitting_drake.scenario.robots import FloatingHand, FrankaArm, Robot
from kitting_drake.scenario.schema import Sleep
from kitting_drake.station import build_station, make_policy
from kitting_drake.tasks import Kitting
from kitting_drake.tasks.boxes import COLOURS, box_object
from kitting_drake.tasks.ravens.palletizing_boxes import PalletizingBoxes
from kitting_drake.tasks.task import TABLE, Scene, TaskConfig
from systems.hand_geometry import JOINT_LIMITS
from systems.pick_place_parameters import PickPlaceParameters
from systems.placement import Goal, Placement
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import Observation, PixelGrid
from systems.success import PoseWithin
from tests.kitting_drake.rig import Rig, build_rig

BASE = Path(__file__).parent
BLIND = Scenario(cameras={})
TWINS = Scenario(task=Kitting(tools=["flat_screwdriver", "flat_screwdriver"]), cameras={})


def build(scenario: Scenario = BLIND) -> Rig:
    return build_rig(scenario, base=BASE)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A station that tests can share, because all state is in the Context."""
    return build()


def advance(rig: Rig, seconds: float, look: Callable[[Context], None] = lambda _: None) -> Context:
    """Simulates the station, in which objects at rest sleep; calls `look` after every step."""

    def monitor(root: Context) -> EventStatus:
        look(root)
        return EventStatus.DidNothing()

    simulator = rig.station.make_simulator(rig.diagram, monitor=monitor)
    simulator.AdvanceTo(seconds)
    return simulator.get_context()


def locked(rig: Rig, root: Context) -> list[bool]:
    context = rig.plant.GetMyContextFromRoot(root)
    return [rig.plant.get_body(item.body).is_locked(context) for item in rig.objects]


def test_default_context_is_the_scene(rig: Rig):
    root = rig.diagram.CreateDefaultContext()
    for X_WB, item in zip(rig.station.object_poses(root), rig.scene.objects, strict=True):
        assert X_WB.IsNearlyEqualTo(item.X_WB, 1e-12)
    assert [item.name for item in rig.objects] == [item.name for item in rig.scene.objects]
    context = rig.plant.GetMyContextFromRoot(root)
    kit = rig.plant.GetBodyByName("kit").EvalPoseInWorld(context)
    assert kit.IsNearlyEqualTo(rig.scene.fixtures[0].X_WF, 1e-12)
    # The hand waits at the planner's home.
    hand = rig.plant.GetModelInstanceByName("franka_hand")
    home = Scenario().planner.home
    np.testing.assert_allclose(
        rig.plant.GetPositionsAndVelocities(context, hand),
        [*home, 0.04, 0.04, *np.zeros(6)],
    )


def test_joint_limits_equal_those_of_the_model(rig: Rig):
    for name, limits in JOINT_LIMITS.items():
        joint = rig.plant.GetJointByName(name)
        found = (*joint.position_lower_limits(), *joint.position_upper_limits())
        assert found == pytest.approx(limits)


def test_the_table_model_matches_the_tasks_table(rig: Rig):
    (geometry,) = rig.plant.GetCollisionGeometriesForBody(rig.plant.GetBodyByName("table"))
    inspector = rig.station.scene_graph.model_inspector()
    X_WTable = rig.plant.GetBodyByName("table").EvalPoseInWorld(
        rig.plant.GetMyContextFromRoot(rig.diagram.CreateDefaultContext())
    )
    middle = (X_WTable @ inspector.GetPoseInFrame(geometry)).translation()
    half_sizes = inspector.GetShape(geometry).size() / 2
    for corner, sign in zip(TABLE, (-1, 1), strict=True):
        np.testing.assert_allclose(corner, (middle + sign * half_sizes)[:2])
    assert middle[2] + half_sizes[2] == pytest.approx(0.0)


def test_initially_objects_touch_the_table_only(rig: Rig):
    context = rig.plant.GetMyContextFromRoot(rig.diagram.CreateDefaultContext())
    results = rig.plant.get_contact_results_output_port().Eval(context)
    assert results.num_point_pair_contacts() == 0
    inspector = rig.station.scene_graph.model_inspector()
    table = {
        str(i) for i in rig.plant.GetCollisionGeometriesForBody(rig.plant.GetBodyByName("table"))
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
    station = build_station(Scenario())
    of_objects = ["success", "add_s", "position_error", "angle_error", "height_error", "at_rest"]
    sizes = {**dict.fromkeys(of_objects, 4), "kept_goals": 4, "reward": 1, "mode": 1, "counts": 4}
    sizes |= {"robot_state": 12, "wrist_force": 6, "commanded": 12, "commanded_opening": 2}
    sizes |= {
        "commanded_closing_force": 1,
        "hand_state": 12,
        "asks": 1,
        "actuation": 6,
        "peak_force": 3,
    }
    abstract = ["placements", "failed_picks", "history", "accepted_action"]
    abstract += ["body_poses", "contact_results"]
    seen = ["observation", "observation_heights"]
    images = ("color_image", "depth_image", "camera_pose")
    seen += [f"{image}_{camera}" for camera in Scenario().cameras for image in images]
    names = [station.get_output_port(i).get_name() for i in range(station.num_output_ports())]
    expected = [*sizes, *abstract, "query_object", *(seen if can_render else [])]
    assert sorted(names) == sorted(expected)
    assert [station.get_input_port(i).get_name() for i in range(1)] == ["action"]
    assert station.num_input_ports() == 1
    context = station.CreateDefaultContext()
    for name, size in sizes.items():
        assert station.GetOutputPort(name).Eval(context).shape == (size,)
    placements = station.GetOutputPort("placements").Eval(context)
    assert [type(item) for item in placements] == [Placement] * 4


def test_the_action_port_can_be_fixed(rig: Rig):
    """A station without a policy takes its action from a fixed port, as in Gymnasium."""
    station, action = build_station(BLIND), rig.port("action")
    simulator = station.make_simulator()
    root = simulator.get_mutable_context()
    station.GetInputPort("action").FixValue(root, Value(action))
    simulator.AdvanceTo(1.0)
    assert station.counts(root) == (1, 0, 0, 0)
    accepted = station.accepted_action(root)
    assert (accepted.pick.x, accepted.place.y) == (action.pick.x, action.place.y)
    assert station.at_rest(root).sum() >= 3


def test_make_simulator_needs_the_outermost_diagram(rig: Rig):
    with pytest.raises(ValueError, match="outermost Diagram"):
        rig.station.make_simulator()


def test_the_oracle_starts_with_the_first_goal(rig: Rig):
    action = rig.port("action")
    (grasp,) = rig.scene.objects[0].grasps
    expected = rig.scene.objects[0].X_WB @ np.array([grasp.x, grasp.y, 0.0])
    np.testing.assert_allclose([action.pick.x, action.pick.y], expected[:2], atol=1e-12)
    # The oracle knows the heights of surfaces without cameras.
    assert action.heights.pick_top == pytest.approx(grasp.surface_height)
    assert action.heights.place_rim == pytest.approx(Kitting().kit.height)


def test_a_quantized_oracle_returns_pixel_centres_and_bins(rig: Rig):
    exact = rig.port("action")
    rounded = build(dataclasses.replace(BLIND, policy=QuantizedOracle(orientations=36))).port(
        "action"
    )
    grid = BLIND.heightmap.grid()
    pixel = grid.to_pixel((rounded.pick.x, rounded.pick.y))
    np.testing.assert_allclose(pixel, np.round(grid.to_pixel((exact.pick.x, exact.pick.y))))
    bins = np.rad2deg(rounded.pick.theta) / 10
    assert bins == pytest.approx(round(np.rad2deg(exact.pick.theta) / 10))


def test_scores_follow_the_objects_poses(rig: Rig):
    root = rig.diagram.CreateDefaultContext()
    assert rig.port("reward", root) == [0.0]
    context = rig.plant.GetMyMutableContextFromRoot(root)
    for item, goal in list(zip(rig.objects, rig.scene.goals, strict=True))[:3]:
        rig.plant.SetFreeBodyPose(context, rig.plant.get_body(item.body), goal.poses[0])
    assert rig.port("success", root).tolist() == [1.0, 1.0, 1.0, 0.0]
    assert rig.port("reward", root) == pytest.approx([0.75])
    assert [item.success for item in rig.station.placements(root)] == [True] * 3 + [False]


def test_objects_at_rest_fall_asleep(rig: Rig):
    asleep: list[list[bool]] = []
    at_rest: list[list[bool]] = []

    def look(root: Context) -> None:
        asleep.append(locked(rig, root))
        at_rest.append(rig.station.at_rest(root).tolist())

    root = advance(rig, 0.6, look)
    assert asleep == at_rest
    assert asleep[0] == [False] * 4
    assert asleep[-1] == [True] * 4
    # Contacts of sleeping objects with the table and the kit are not computed.
    results = rig.plant.get_contact_results_output_port().Eval(rig.plant.GetMyContextFromRoot(root))
    assert results.num_hydroelastic_contacts() == 0


def test_a_sleeping_stack_has_no_contacts_until_it_wakes():
    rig = build(Scenario(task=PalletizingBoxes(layers=2), cameras={}))
    for item, goal in zip(rig.objects, rig.scene.goals, strict=True):
        rig.plant.SetDefaultFloatingBaseBodyPose(rig.plant.get_body(item.body), goal.poses[0])

    def contacts(root: Context) -> int:
        context = rig.plant.GetMyContextFromRoot(root)
        port = rig.plant.get_contact_results_output_port()
        return port.Eval(context).num_hydroelastic_contacts()

    counts: list[int] = []
    root = advance(rig, 0.6, lambda root: counts.append(contacts(root)))
    assert max(counts) > 12
    assert counts[-1] == 0
    assert all(locked(rig, root))
    # Wake the last box, which is the highest, so that it touches the sleeping ones.
    top = len(rig.objects) - 1
    at_rest = rig.station.at_rest(root)
    at_rest[top] = False
    rig.station._free_bodies().apply_sleep(root, at_rest)
    assert locked(rig, root) == [True] * top + [False]
    Simulator(rig.diagram, root).AdvanceTo(root.get_time() + 0.01)
    assert 0 < contacts(root) < max(counts)


def test_an_object_that_leaves_the_cell_comes_to_rest(rig: Rig):
    """If it kept spinning as a free body, its quaternion would overflow within two seconds."""
    simulator = rig.station.make_simulator(rig.diagram)
    root = simulator.get_mutable_context()
    context = rig.plant.GetMyMutableContextFromRoot(root)
    # This object is not the one that the oracle picks first.
    flung = rig.plant.get_body(rig.objects[-1].body)
    velocity = SpatialVelocity([0, 0, 4000.0], [300.0, 200.0, 300.0])
    rig.plant.SetFreeBodySpatialVelocity(context, flung, velocity)
    simulator.AdvanceTo(2.5)
    assert np.isfinite(rig.plant.GetPositions(context)).all()
    assert locked(rig, root)[-1]
    assert not rig.port("placements", root)[-1].success


def test_sleep_can_be_switched_off():
    rig = build(dataclasses.replace(TWINS, sleep=Sleep(enabled=False)))
    asleep: list[list[bool]] = []
    root = advance(rig, 0.6, lambda root: asleep.append(locked(rig, root)))
    assert len(asleep) > 70
    assert not np.any(asleep)
    assert rig.station.at_rest(root).all()  # Objects rest, but none is frozen.


@pytest.mark.slow
def test_two_runs_of_a_seed_are_bit_identical():
    """Compares states in the middle of the first grasp, when other objects sleep."""

    def final_state() -> NDArray[np.float64]:
        rig = build(TWINS)
        root = advance(rig, 3.0)
        assert rig.port("counts", root)[0] == 1
        context = rig.plant.GetMyContextFromRoot(root)
        return rig.plant.get_state_output_port().Eval(context).copy()

    np.testing.assert_array_equal(final_state(), final_state())


def test_one_model_can_occur_twice():
    rig = build(TWINS)
    one, other = (rig.plant.get_body(item.body) for item in rig.objects)
    assert one.index() != other.index()
    assert one.model_instance() != other.model_instance()
    here, there = rig.station.object_poses(rig.diagram.CreateDefaultContext())
    assert np.linalg.norm(here.translation() - there.translation()) > 0.02


SMALL = {
    name: dataclasses.replace(camera, width=160, height=120, focal_length=112.5)
    for name, camera in Scenario().cameras.items()
    if isinstance(camera, Pinhole)
}


@pytest.mark.usefixtures("rendering")
def test_a_learned_policy_acts_on_the_observation(weights_file: Path):
    told: list[Observation] = []
    rig = build_rig(
        Scenario(policy=Learned(weights=weights_file.name, orientations=36), cameras=SMALL),
        seed=0,
        base=weights_file.parent,
        observer=lambda observation, _: told.append(observation),
    )
    context = rig.diagram.CreateDefaultContext()
    observation = rig.port("observation", context)
    assert observation.height.any()
    assert not told
    found = rig.port("action", context)
    stages = make_stages(PickPlaceParameters(), insertion=True)
    networks = load_networks(weights_file, preferred_type())
    assert found == LearnedPolicy(networks, orientations=36, stages=stages)(observation)
    (seen,) = told
    np.testing.assert_array_equal(seen.image, observation.image)
    # As the inputs are unchanged, the policy is not called again.
    assert rig.port("action", context) == found
    assert len(told) == 1


@pytest.mark.parametrize(
    ("policy", "sight"),
    [
        (ShapeMatching(), "observation_heights"),
        pytest.param(Learned(), "observation_heights", marks=pytest.mark.slow),
        (Learned(weights=str(MODELS / "policies" / "kitting_seen.safetensors")), "observation"),
        (PythonPolicy(function="systems.signals:PickPlaceAction"), "observation"),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_colours_are_rendered_only_for_a_policy_that_sees_them(policy: PolicyConfig, sight: str):
    station = build_station(Scenario(policy=policy, cameras=SMALL))
    system = make_policy(station)
    looks = [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
    assert [name for name in looks if name.startswith("observation")] == [sight]


@pytest.mark.usefixtures("rendering")
def test_a_decision_observer_gets_colours():
    told: list[Observation] = []
    rig = build_rig(
        Scenario(policy=Learned(orientations=36), cameras=SMALL),
        seed=0,
        base=BASE,
        observer=lambda observation, _: told.append(observation),
    )
    rig.port("action")
    assert told[0].rgb.any()


def test_a_policy_with_observations_needs_cameras_and_rendering(monkeypatch: pytest.MonkeyPatch):
    looks = PythonPolicy(function="systems.signals:PickPlaceAction")
    with pytest.raises(UserError, match="cameras"):
        build(dataclasses.replace(BLIND, policy=looks))
    monkeypatch.setattr("kitting_drake.common.rendering.can_render", lambda: False)
    with pytest.raises(UserError, match="libEGL"):
        build(Scenario(policy=looks))


@pytest.mark.parametrize(
    "name",
    [
        "OneOfEverything",
        "OneOfEverythingElse",
        pytest.param("OneOfEverythingDrawn", marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_one_of_everything_builds_and_steps(name: str):
    scenario = load_scenario(BASE.parent / "scenario" / "test_scenarios.yaml", name)
    rig = build(scenario)
    assert rig.station.has_cameras
    assert rig.plant.time_step() == scenario.plant.time_step
    root = advance(rig, 0.1)
    observation = rig.port("observation", root)
    assert observation.grid == scenario.heightmap.grid()
    assert observation.height.any()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{heightmap: {z_max: 0.03}}", "heightmap.z_max"),
        ("{planner: {open_width: 0.01}}", "planner.open_width"),
        ("{heightmap: {z_min: -0.03}, policy: !Learned {weights: ''}}", "z_min"),
        ("{task: !StackBlockPyramid {}, policy: !Learned {weights: '', recover: true}}", "recover"),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_invalid_scenarios_raise(text: str, sentence: str):
    scenario = load_scenario(SCENARIOS / "paper/kitting_seen.yaml", text=text)
    with pytest.raises(UserError, match=sentence):
        build(scenario)


# Invalid scenes of a user's own task.


@dataclasses.dataclass
class Cube(TaskConfig):
    """A cube at x that should be at `goal_x`."""

    x: float = 0.5
    goal_x: float = 0.6
    object: int = 0
    after: int | None = None
    reward: float = 1.0
    name: str = "cube"
    returns: bool = True

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Any:
        cubes = tuple(
            box_object(name, "cube", (0.04,) * 3, COLOURS["red"], RigidTransform([self.x, y, 0]))
            for name, y in (("cube", 0.1), (self.name, -0.1))
        )
        after = () if self.after is None else (self.after,)
        pose = RigidTransform([self.goal_x, 0.1, 0])
        goal = Goal("here", (self.object,), (pose,), self.reward, after=after)
        scene = Scene(cubes, (), (goal,), PoseWithin(), max_actions=2)
        return scene if self.returns else None


OFF = "is not on the table: choose x from 0 to 1 m and y from -0.75 to 0.75 m"


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (Cube(name="other"), None),
        (Cube(), "the name 'cube' is given to several objects or fixtures"),
        (Cube(name="other", reward=0.5), "the goals' rewards must add up to 1, not 0.5"),
        (
            Cube(name="other", object=2),
            "the goal 'here' refers to object 2, but the indices of objects are 0 to 1",
        ),
        (
            Cube(name="other", after=-1),
            "the goal 'here' refers to goal -1, but the indices of goals are 0 to 0",
        ),
        (
            Cube(name="other", returns=False),
            "task: make_scene must return a Scene, but returns None",
        ),
        (Cube(name="other", x=1.2), f"the object 'cube' at (1.20, 0.10) m {OFF}"),
        (Cube(name="other", goal_x=-0.1), f"the goal 'here' at (-0.10, 0.10) m {OFF}"),
    ],
)
def test_an_invalid_scene_of_an_own_task_raises(task: Any, sentence: str | None):
    scenario = dataclasses.replace(BLIND, task=task)
    if sentence is None:
        build_station(scenario)
        return
    with pytest.raises(UserError) as caught:
        build_station(scenario)
    assert str(caught.value) == sentence


# Unusable models.


@pytest.fixture
def own_tool(tmp_path: Path) -> Path:
    """The folder of a copied tool whose model refers to the meshes beside it."""
    folder = Path(shutil.copytree(MODELS / "tools" / "flat_screwdriver", tmp_path / "mine"))
    sdf = folder / "flat_screwdriver.sdf"
    package = "package://kitting_models/tools/flat_screwdriver/"
    sdf.write_text(sdf.read_text().replace(package, ""))
    return folder


def with_tool(folder: Path) -> Scenario:
    return dataclasses.replace(BLIND, task=Kitting(tools=[str(folder)]))


def test_a_custom_tool(own_tool: Path):
    rig = build(with_tool(own_tool))
    body = rig.plant.get_body(rig.objects[0].body)
    assert len(rig.plant.GetCollisionGeometriesForBody(body)) == 6


@pytest.mark.parametrize("spoilt", ["collision_0.obj", "flat_screwdriver.sdf"])
def test_a_model_that_cannot_be_parsed_raises_user_error(own_tool: Path, spoilt: str):
    if spoilt.endswith(".obj"):
        (own_tool / spoilt).unlink()
    else:
        (own_tool / spoilt).write_text("<sdf")
    with pytest.raises(UserError, match=spoilt):
        build(with_tool(own_tool))


def test_an_invalid_mesh_raises_user_error(own_tool: Path):
    for name in ("red_grip.obj", "black_rubber.obj", "polished_steel.obj"):
        (own_tool / name).write_text("not a mesh\n")
    with pytest.raises(UserError, match="obj"):
        build(with_tool(own_tool))


@pytest.mark.parametrize(
    ("policy", "robot"),
    [
        pytest.param(Oracle(), FloatingHand(), marks=pytest.mark.slow),
        (PythonPolicy(function="systems.signals:PickPlaceAction"), FloatingHand()),
        (PythonPolicy(function="systems.signals:PickPlaceAction"), FrankaArm()),
    ],
)
@pytest.mark.usefixtures("rendering", "freed_diagrams")
def test_unused_stations_are_garbage_collected(policy: PolicyConfig, robot: Robot):
    """Otherwise building stations in a loop would leak memory."""
    scenario = Scenario(
        policy=policy, robot=robot, sensor_noise=SensorNoiseParameters(depth_std=0.001)
    )
    rig = build(scenario)
    simulator = rig.station.make_simulator(rig.diagram)
    simulator.AdvanceTo(0.01)
    diagram, station = weakref.ref(rig.diagram), weakref.ref(rig.station)
    del rig, simulator
    gc.collect()
    assert diagram() is None
    assert station() is None
