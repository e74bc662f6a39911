import numpy as np
import pytest

from kitting_drake.episode.arm_use import ArmUseMeter
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.robot import ARM
from kitting_drake.tasks import Kitting
from systems.arm_limits import FR3
from tests.kitting_drake.rig import Rig, build_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build_rig(Scenario(robot=FrankaArm(), task=Kitting(tools=["claw_hammer"]), cameras={}))


def advance(rig: Rig, seconds: float, joints: np.ndarray | None = None) -> ArmUseMeter:
    """Simulates for some seconds, from the given joint positions if there are any."""
    meter = ArmUseMeter(rig.station)

    def look(root):
        meter.sample(root)

    simulator = rig.station.make_simulator(rig.diagram, monitor=look)
    root = simulator.get_mutable_context()
    if joints is not None:
        context = rig.plant.GetMyMutableContextFromRoot(root)
        rig.plant.SetPositions(context, rig.plant.GetModelInstanceByName(ARM), joints)
    simulator.AdvanceTo(seconds)
    return meter


def test_a_planned_motion_stays_within_all_limits(rig: Rig):
    use = advance(rig, 1.0).result()
    for share in (use.position, use.velocity, use.acceleration, use.jerk, use.torque):
        assert 0.05 < share < 1.0
    assert use.acceleration > 0.9
    assert use.collisions == []


def test_a_wrist_in_the_table_is_a_collision(rig: Rig):
    # The arm reaches far forward and low, so that its wrist lies in the table.
    use = advance(rig, 1 / 64, np.array([0.0, 1.2, 0.0, -1.3, 0.0, 1.6, 0.0])).result()
    assert any("table" in pair and "link" in pair for pair in use.collisions)


def test_a_position_beyond_its_limit_is_a_share_above_1(rig: Rig):
    joints = np.array([0.0, -0.4, 0.0, -1.9, 0.0, 1.6, 1.02 * FR3.upper[6]])
    assert advance(rig, 1 / 128, joints).result().position == pytest.approx(1.02, abs=0.01)
