"""The expert solves the Ravens tasks in simulated episodes."""

import pytest

from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import AssemblingKits, BlockInsertion, StackBlockPyramid
from kitting_drake.tasks.task import TaskConfig
from systems.pick_place_parameters import PickPlaceParameters
from tests.kitting_drake.rig import build_rig

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("task", "share"), [(BlockInsertion(), 1.0), (StackBlockPyramid(), 1 / 6)])
def test_the_expert_succeeds_at_the_first_action(task: TaskConfig, share: float):
    scenario = Scenario(task=task, cameras={}, planner=PickPlaceParameters(max_actions=1))
    result = build_rig(scenario).run(seconds=30.0)
    assert result.failure is None
    assert not result.timed_out
    assert [record.outcome for record in result.actions_taken] == ["placed"]
    assert result.success_rate == pytest.approx(share)
    assert result.strict_success_rate == pytest.approx(share)
    assert result.point_contact_pairs == 0
    assert result.moving_at_end == []


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_expert_assembles_a_kit(split: str):
    scenario = Scenario(task=AssemblingKits(split=split), cameras={})
    result = build_rig(scenario).run(seconds=90.0)
    assert (result.failure, result.timed_out, result.actions) == (None, False, 5)
    told = [(item.name, item.measures, item.cause) for item in result.objects]
    assert all(all(item.measures.values()) for item in result.objects), told
    assert result.point_contact_pairs == 0
