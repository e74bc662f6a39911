import dataclasses

import pytest

from kitting_drake.scenario import Scenario
from kitting_drake.scenario.cameras import LookAt, Pinhole
from kitting_drake.station.hidden_table import hidden_table_note
from systems.pick_place_parameters import PickPlaceParameters

ABOVE = Pinhole(position=[0.5, 0.0, 1.1], rpy_deg=[180.0, 0.0, -90.0])
BESIDE = PickPlaceParameters(home=[-0.4, 0.0, 0.4, 0.0])


def test_the_default_cameras_do_not_see_the_waiting_hand():
    assert hidden_table_note(Scenario()) is None


@pytest.mark.parametrize("camera", [ABOVE, LookAt(position=[0.5, 0.01, 1.1])])
def test_a_camera_above_sees_it_unless_it_waits_elsewhere(camera: Pinhole | LookAt):
    scenario = Scenario()
    scenario = dataclasses.replace(scenario, cameras={**scenario.cameras, "overhead": camera})
    assert "from camera overhead: choose another home" in hidden_table_note(scenario)
    assert hidden_table_note(dataclasses.replace(scenario, planner=BESIDE)) is None


def test_it_returns_to_any_y():
    """A camera over the workspace's end, where the hand does not wait at first."""
    end = Pinhole(position=[0.5, -0.45, 1.1], rpy_deg=[180.0, 0.0, -90.0], focal_length=1500.0)
    assert hidden_table_note(Scenario(cameras={"end": end})) is not None
