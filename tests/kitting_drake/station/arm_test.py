from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.framework import Context, EventStatus

from kitting_drake.episode import run_episode
from kitting_drake.episode.episode_log import EpisodeLog
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.robot import ARM, HAND, arm_model
from kitting_drake.tasks import Kitting
from systems.arm_kinematics import joint_frames
from systems.arm_limits import ARM_LIMITS
from tests.kitting_drake.rig import Rig, build_rig

BASE = Path(__file__).parent
HOME = [*Scenario().planner.home[:2], FrankaArm().highest_wait, 0.0]
ONE_TOOL = Kitting(tools=["claw_hammer"])


def scenario(**changes: object) -> Scenario:
    return Scenario(robot=FrankaArm(**changes), task=ONE_TOOL, cameras={})


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build_rig(scenario(), base=BASE)


@pytest.mark.parametrize("model", ARM_LIMITS)
def test_the_model_has_the_published_limits_and_kinematics(model: str):
    plant, _ = arm_model(FrankaArm(model=model, base=[0.0, 0.0, 0.0]))
    arm, limits = plant.GetModelInstanceByName(ARM), ARM_LIMITS[model]
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(arm)]
    joints = [joint for joint in joints if joint.num_positions()]
    assert [it.position_lower_limits()[0] for it in joints] == pytest.approx(limits.lower)
    assert [it.position_upper_limits()[0] for it in joints] == pytest.approx(limits.upper)
    assert [it.velocity_upper_limits()[0] for it in joints] == pytest.approx(limits.velocity)
    efforts = [plant.GetJointActuatorByName(it.name(), arm).effort_limit() for it in joints]
    assert efforts == pytest.approx(limits.torque)
    q = np.array([0.3, -0.4, 0.5, -1.9, 0.6, 2.1, -0.7])
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, arm, q)
    rotations, origins = joint_frames(q)
    X_WFlange = plant.GetFrameByName("link8").CalcPoseInWorld(context)
    np.testing.assert_allclose(X_WFlange.translation(), origins[7], atol=1e-12)
    np.testing.assert_allclose(X_WFlange.rotation().matrix(), rotations[7], atol=1e-12)


def test_ports_and_home(rig: Rig):
    root = rig.diagram.CreateDefaultContext()
    sizes = {"robot_state": 18, "hand_state": 12, "commanded": 21, "actuation": 9}
    sizes |= {"wrist_force": 6, "commanded_opening": 2}
    for name, size in sizes.items():
        assert rig.port(name, root).shape == (size,)
    # The joints have the first commanded positions, and the hand is at the planner's home.
    state = rig.port("robot_state", root)
    np.testing.assert_allclose(state[:7], rig.port("commanded", root)[:7], atol=1e-12)
    hand = rig.port("hand_state", root)
    np.testing.assert_allclose(hand[:6], [*HOME, 0.04, 0.04], atol=1e-6)
    # The hand has only its two finger joints, not the axes of a floating hand.
    assert rig.plant.num_positions(rig.plant.GetModelInstanceByName(HAND)) == 2


def steps(rig: Rig, seconds: float) -> NDArray[np.float64]:
    """The robot's state and actuation after each step, as an array (n, 27)."""
    found = []

    def look(root):
        found.append([*rig.port("robot_state", root), *rig.port("actuation", root)])
        return EventStatus.DidNothing()

    simulator = rig.station.make_simulator(rig.diagram, monitor=look)
    simulator.AdvanceTo(seconds)
    return np.array(found)


def test_the_arm_follows_its_commands_and_a_rerun_is_equal(rig: Rig):
    found = steps(rig, 1.0)
    np.testing.assert_array_equal(found, steps(rig, 1.0))
    limits = ARM_LIMITS["fr3"]
    assert np.ptp(found[:, :7], axis=0).max() > 0.1
    assert (np.abs(found[:, 9:16]) <= np.array(limits.velocity)).all()
    assert (np.abs(found[:, 18:25]) < np.array(limits.torque)).all()


def press(rig: Rig, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pulls the waiting hand down with a force (N) for 0.09 s.

    Returns:
        The actuation, and how far the joints have moved.
    """
    simulator = rig.station.make_simulator(rig.diagram)
    root = simulator.get_mutable_context()
    pulled = ExternallyAppliedSpatialForce()
    pulled.body_index = rig.plant.GetBodyByName("hand").index()
    pulled.p_BoBq_B = np.zeros(3)
    pulled.F_Bq_W = SpatialForce(np.zeros(3), np.array([0.0, 0.0, -force]))
    context = rig.plant.GetMyMutableContextFromRoot(root)
    rig.plant.get_applied_spatial_force_input_port().FixValue(context, [pulled])
    before = rig.port("robot_state", root)[:7]
    simulator.AdvanceTo(0.09)
    return rig.port("actuation", root), rig.port("robot_state", root)[:7] - before


def test_torques_are_clipped(rig: Rig):
    assert np.abs(press(rig, 5.0)[0][:7]).max() < 20.0
    limit = np.array(ARM_LIMITS["fr3"].torque)
    strong, moved = press(rig, 2000.0)
    assert (np.abs(strong[:7]) <= limit + 1e-9).all()
    assert np.isclose(np.abs(strong[:7]), limit).any()
    assert np.abs(moved).max() > 0.05


class ForceLog(EpisodeLog):
    """An episode log that also records the contact forces on the hand, from the plant."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig.station)
        self._rig = rig
        self.forces: list[NDArray[np.float64]] = []

    def sample(self, root_context: Context) -> None:
        super().sample(root_context)
        plant, total = self._rig.plant, np.zeros(3)
        hand = plant.GetBodyIndices(plant.GetModelInstanceByName(HAND))
        of_hand = {
            str(it) for b in hand for it in plant.GetCollisionGeometriesForBody(plant.get_body(b))
        }
        contacts = self._rig.port("contact_results", root_context)
        for index in range(contacts.num_hydroelastic_contacts()):
            info = contacts.hydroelastic_contact_info(index)
            surface, on_first = info.contact_surface(), info.F_Ac_W().translational()
            total += (str(surface.id_M()) in of_hand) * on_first
            total -= (str(surface.id_N()) in of_hand) * on_first
        self.forces.append(total)


@pytest.mark.slow
@pytest.mark.parametrize("model", ARM_LIMITS)
def test_an_episode_is_as_gentle_as_the_floating_hands(model: str):
    """A hard set-down would unload a pad, so that the tool would count as dropped."""
    scenario = Scenario(robot=FrankaArm(model=model), task=Kitting(), cameras={})
    rig = build_rig(scenario, base=BASE)
    log = ForceLog(rig)
    result = run_episode(rig.diagram, rig.station, scenario="test", policy="oracle", log=log)
    assert result.strict_success_rate == 1.0
    assert (result.missed_grasps, result.dropped_objects, result.stopped_actions) == (0, 0, 0)
    arrays = log.arrays()
    # The force that is computed from joint torques equals the contact force.
    applied, felt = np.array(log.forces), arrays["wrist_force"][:, :3]
    assert np.abs(applied).max() > 5.0
    assert np.abs(felt - applied).max() < 0.01 * np.abs(applied).max()
    # The limit holds for means over two steps, which the contact guard uses.
    vertical = felt[:, 2]
    assert ((vertical[1:] + vertical[:-1]) / 2).max() < 30.0
    assert list(arrays["joint_names"]) == [f"joint{number}" for number in range(1, 8)]
    limits = ARM_LIMITS[model]
    assert (arrays["joint_position"] > np.array(limits.lower)).all()
    assert (arrays["joint_position"] < np.array(limits.upper)).all()
    assert (np.abs(arrays["joint_velocity"]) <= np.array(limits.velocity)).all()
    assert (np.abs(arrays["joint_torque"]) < np.array(limits.torque)).all()
    # The torque rates include those that contacts cause.
    rates = np.diff(arrays["joint_torque"], axis=0) / np.diff(arrays["time"])[:, None]
    assert (np.abs(rates) < np.array(limits.torque_rate)).all()
    assert np.abs(arrays["joint_position"] - arrays["commanded_position"]).max() < 0.003
