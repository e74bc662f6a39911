"""The number of actions that the memory of failed grasps can have changed: exact, or a range."""

from typing import Any

import pytest

from kitting_drake.evaluation.summary import actions_after_failed_grasp
from kitting_drake.reproduction.paper.failed_grasps import changeable


def summary(outcomes: list[list[int]], missed: int, dropped: int = 0, **fields: Any) -> dict:
    """The summary of a run, with the given outcomes of each episode's objects."""
    return {
        "resolved_scenario": {"task": {"_tag": "!ToolsetKitting"}},
        "policy_details": {},
        "outcomes": [{"objects": dict(enumerate(ends))} for ends in outcomes],
        "missed_grasps": missed,
        "dropped_objects": dropped,
    } | fields


GOOD, ONE_LOST = [2, 2, 1, 2], [2, 2, 0, 2]


def test_without_failed_grasps_nothing_changes():
    assert changeable(summary([GOOD, ONE_LOST], 0, actions=8)).text == "0 of 8"


def test_a_failed_grasp_precedes_at_most_three_of_four_actions():
    assert changeable(summary([GOOD, GOOD, ONE_LOST], 1, actions=12)).text == "0 to 3 of 12"
    # Both failures are in the same episode, so the second one follows a failed grasp.
    assert changeable(summary([[0, 0, 2, 2]], 1, 1, actions=4)).text == "1 to 3 of 4"


def test_placed_objects_took_their_own_actions():
    pyramid = {"resolved_scenario": {"task": {"_tag": "!StackBlockPyramid"}}}
    found = changeable(summary([[2] * 6, [2, 2, 2, 2, 2, 0]], 2, actions=14, **pyramid))
    assert found.text == "0 to 12 of 14"
    found = changeable(summary([[2] * 6, [2, 2, 2, 2, 2, 0]], 1, actions=14, **pyramid))
    # One episode has the failed grasp. The other one placed at least five cubes, in at least five
    # actions. This leaves at most nine for the first episode; eight can follow the failed grasp.
    assert found.text == "0 to 8 of 14"
    assert changeable(summary([[2] * 6], 1, **pyramid)).text == "0 to 11 of 12"


def test_counted_actions_need_no_bounds():
    counted = summary([ONE_LOST], 1, actions=4, actions_after_failed_grasps=2)
    assert changeable(counted).text == "2 of 4"
    forgets = {"policy_details": {"avoid_failed_picks": False}}
    assert changeable(counted | forgets).text == "0 of 4"


@pytest.mark.parametrize(
    ("outcomes", "count"),
    [
        (["placed", "placed"], 0),
        (["placed", "missed", "placed", "dropped", "placed"], 3),
        (["placed", "dropped"], 0),
        ([], 0),
    ],
)
def test_actions_are_counted_from_the_first_failure_on(outcomes: list[str], count: int):
    episode = {"actions_taken": [{"outcome": outcome} for outcome in outcomes]}
    assert actions_after_failed_grasp(episode) == count
