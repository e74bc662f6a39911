import dataclasses

import pytest

from kitting_drake.scenario import Scenario
from kitting_drake.scenario.cameras import LookAt, Pinhole
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.hidden_table import hidden_table_note
from systems.pick_place_parameters import PickPlaceParameters

ABOVE = Pinhole(position=[0.5, 0.0, 1.1], rpy_deg=[180.0, 0.0, -90.0])
BESIDE = PickPlaceParameters(home=[-0.4, 0.0, 0.4, 0.0])


def test_the_default_cameras_do_not_see_the_waiting_hand():
    assert hidden_table_note(Scenario()) is None


def test_cameras_that_see_none_of_the_workspace():
    up = LookAt(position=[0.5, 0.0, 0.75], target=[0.6, 0.0, 2.0])
    blind = Scenario(cameras={"up": up})
    assert hidden_table_note(blind) == (
        "the cameras see 0 % of the workspace: turn them towards the table"
    )
    assert hidden_table_note(Scenario(cameras={})) is None
    seeing = dataclasses.replace(blind, cameras={**Scenario().cameras, "up": up})
    assert hidden_table_note(seeing) is None


@pytest.mark.parametrize("camera", [ABOVE, LookAt(position=[0.5, 0.01, 1.1])])
def test_an_overhead_camera_sees_the_waiting_hand_at_the_default_home(camera: Pinhole | LookAt):
    scenario = Scenario()
    scenario = dataclasses.replace(scenario, cameras={**scenario.cameras, "overhead": camera})
    assert "camera overhead" in hidden_table_note(scenario)
    assert hidden_table_note(dataclasses.replace(scenario, planner=BESIDE)) is None


@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_the_default_cameras_see_all_of_the_table_beside_an_arm(model: str):
    assert hidden_table_note(Scenario(robot=FrankaArm(model=model))) is None


def test_a_waiting_arm_hides_more_than_its_hand():
    # The camera is behind the arm: the arm hides the table, but a hand alone would not.
    behind = LookAt(position=[-0.25, 0.0, 0.9])
    hand = Scenario(cameras={"behind": behind})
    assert hidden_table_note(hand) is None
    note = hidden_table_note(dataclasses.replace(hand, robot=FrankaArm()))
    assert "where the arm waits" in note
    assert "camera behind" in note


def test_the_hand_may_wait_at_any_y():
    """The camera is over an end of the workspace. The hand begins elsewhere, but may wait there."""
    end = Pinhole(position=[0.5, -0.45, 1.1], rpy_deg=[180.0, 0.0, -90.0], focal_length=1500.0)
    assert hidden_table_note(Scenario(cameras={"end": end})) is not None
