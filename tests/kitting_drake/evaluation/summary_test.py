import dataclasses
import json

import pytest

from kitting_drake.evaluation.intervals import mean_interval, proportion_interval
from kitting_drake.evaluation.summary import summarise
from kitting_drake.evaluation.terminal import summary_notes
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import StackBlockPyramid
from systems.success import PoseWithin
from tests.kitting_drake.evaluation.episodes import (
    ADD_S,
    CHOSEN,
    make_episode,
    make_lost_episode,
    make_object,
    make_result,
)

# Other programs read these keys.
KEYS = {
    "episodes",
    "failed_episodes",
    "timed_out_episodes",
    "success_rate",
    "ci95",
    "strict_success_rate",
    "strict_ci95",
    "add_s_mm",
    "position_error_mm",
    "angle_error_deg",
    "height_error_mm",
    "sim_seconds",
    "wall_seconds",
    "wall_seconds_total",
    "policy",
    "scenario",
    "seeds",
    "task",
    "resolved_scenario",
    "policy_details",
    "policy_digest",
    "versions",
    "commit",
    "success_description",
    "actions_after_failed_grasps",
    "missed_grasps",
    "dropped_objects",
    "point_contact_pairs",
    "moving_at_end",
}
CAUSES = dict.fromkeys((*Scenario().task.causes, "failed episode", "timed out"), 0)


def summarised(episodes: list[dict]) -> dict:
    summary = summarise(episodes, CHOSEN, ADD_S, wall_seconds_total=25.0)
    return json.loads(json.dumps(summary))


def test_failed_episodes_count_zero():
    episodes = [
        make_episode(0, [1.0, 1.0]),
        make_episode(1, [1.0, 9.0], moving_at_end=["bolt"]),
        make_episode(2, [1.0, 1.0], failure="solver"),
        make_episode(3, [1.0, 700.0], timed_out=True),
    ]
    summary = summarised(episodes)
    assert summary.keys() >= KEYS
    assert (summary["episodes"], summary["seeds"]) == (4, [0, 1, 2, 3])
    assert (summary["failed_episodes"], summary["timed_out_episodes"]) == (1, 1)
    assert summary["success_rate"] == pytest.approx(3 / 8)
    assert summary["ci95"] == pytest.approx(proportion_interval(3, 8))
    assert summary["causes"] == CAUSES | {"misplaced": 1, "failed episode": 2, "timed out": 2}
    # Failed and timed-out episodes do not contribute errors.
    assert summary["add_s_mm"] == pytest.approx({"median": 1.0, "p95": 7.8, "max": 9.0})
    assert summary["action_errors"]["place_position_error_mm"]["max"] == pytest.approx(18.0)
    assert (summary["wall_seconds"], summary["wall_seconds_total"]) == (40.0, 25.0)
    assert summary["moving_at_end"] == 1


def test_needless_actions_are_counted():
    """An action is needless if its object is a distractor, or one for which no goal is left."""
    episodes = [make_episode(0, [1.0, 9.0]), make_episode(1, [1.0, 1.0])]
    assert summarised(episodes)["needless_actions"] == 0
    episodes[0]["actions_taken"][0]["object"] = "distractor_1"
    episodes[1]["objects"][1]["add_s_mm"] = None
    summary = summarised(episodes)
    assert (summary["needless_actions"], summary["actions"]) == (2, 4)


def test_objects_that_are_moved_although_placed_are_counted():
    """A press and a missed grasp move nothing."""
    episodes = [make_episode(0, [1.0, 1.0]), make_episode(1, [1.0, 1.0])]
    for episode in episodes:
        for action in episode["actions_taken"]:
            action["was_placed"] = True
    episodes[0]["actions_taken"][0]["outcome"] = "pressed"
    episodes[0]["actions_taken"][1]["outcome"] = "missed"
    episodes[1]["actions_taken"][0]["was_placed"] = False
    assert summarised(episodes)["repeated_moves"] == 1


def test_a_summary_holds_what_reproduces_it():
    summary = summarised([make_episode(0, [1.0])])
    assert summary["task"] == "kitting-seen-toolset"
    assert summary["success_description"] == "ADD-S below 3.5 mm"
    assert summary["resolved_scenario"]["plant"]["time_step"] == Scenario().plant.time_step
    assert (summary["policy_details"], summary["policy_digest"]) == ({"method": "oracle"}, None)
    assert "drake" in summary["versions"]


def test_categories_add_up_to_the_whole():
    episodes = [
        make_episode(0, [1.0, 1.0]),
        make_episode(1, [2.0, 9.0]),
        make_episode(2, [1.0, 1.0], failure="solver"),
        # The names of a lost episode's objects are unknown.
        make_lost_episode(3),
    ]
    summary = summarised(episodes)
    assert list(summary["categories"]) == ["bolt", "cup"]
    bolt, cup = summary["categories"].values()
    assert (cup["objects"], cup["success_rate"]) == (4, 0.5)
    assert (bolt["objects"], bolt["success_rate"]) == (4, 0.25)
    assert bolt["ci95"] == pytest.approx(proportion_interval(1, 4))
    assert summary["success_rate"] == pytest.approx((0.5 + 0.25) / 2)
    assert cup["position_error_mm"]["median"] == pytest.approx(1.5)
    assert cup["action_errors"]["place_angle_error_deg"]["median"] == pytest.approx(4.5)
    assert bolt["causes"] == CAUSES | {"misplaced": 1, "failed episode": 2}
    for cause, count in summary["causes"].items():
        assert count == sum(row["causes"][cause] for row in summary["categories"].values())


def test_other_measures_have_rates():
    near, far = {"loose": True, "tight": True}, {"loose": True, "tight": False}
    objects = [
        dataclasses.replace(make_object("cup", 1.0), measures=near),
        dataclasses.replace(make_object("bolt", 2.0), measures=far),
    ]
    lost = make_result(1, objects, timed_out=True).as_dict()
    summary = summarised([make_result(0, objects).as_dict(), lost])
    rates = {name: row["success_rate"] for name, row in summary["measures"].items()}
    assert rates == {"loose": 0.5, "tight": 0.25}
    assert summary["measures"]["tight"]["ci95"] == pytest.approx(proportion_interval(1, 4))
    assert summary["categories"]["bolt"]["measures"]["tight"]["success_rate"] == 0
    assert "success by each measure: loose 50.0%, tight 25.0%" in summary_notes(summary)
    assert summarised([make_episode(0, [1.0])])["measures"] == {}


def test_ambiguous_successes_are_not_strict():
    """A flat object that protrudes or lies reversed can pass by ADD-S, but is no strict success."""
    objects = [
        make_object("cup", 1.0, height_error_mm=2.5),
        make_object("bolt", 1.0, angle_error_deg=178.0),
        make_object("block", 1.0, height_error_mm=1.5, angle_error_deg=19.0),
        make_object("ring", 9.0, height_error_mm=20.0),
    ]
    summary = summarised([make_result(0, objects).as_dict()])
    assert (summary["success_rate"], summary["strict_success_rate"]) == (0.75, 0.25)
    assert summary["strict_ci95"] == pytest.approx(proportion_interval(1, 4))
    assert summary["ambiguous"] == {"protruding": 1, "reversed": 1}
    bolt = summary["categories"]["bolt"]
    assert bolt["ambiguous"] == {"protruding": 0, "reversed": 1}
    assert (bolt["success_rate"], bolt["strict_success_rate"]) == (1.0, 0.0)


def test_objects_without_a_goal_are_excluded():
    objects = [make_object(name, error) for name, error in (("cup", 1.0), ("spare_cup", None))]
    summary = summarised([make_result(0, objects).as_dict()])
    assert list(summary["categories"]) == ["cup"]
    assert (summary["success_rate"], summary["causes"]) == (1.0, CAUSES)
    assert summary["ci95"] == pytest.approx(proportion_interval(1, 1))
    # The object without a goal has pick errors, but no place errors.
    assert summary["action_errors"]["place_position_error_mm"]["max"] == pytest.approx(2.0)


def test_intervals_of_partial_rewards_are_over_episodes():
    episodes = [
        make_episode(seed, [9.0, 9.0], success_rate=score)
        for seed, score in enumerate((0.8, 0.9, 0.7))
    ]
    summary = summarise(episodes, CHOSEN, PoseWithin(), wall_seconds_total=1.0)
    assert summary["success_rate"] == pytest.approx(0.8)
    assert summary["ci95"] == pytest.approx(mean_interval([0.8, 0.9, 0.7]))
    assert summary["ci95_method"] == "Student or Wilson, over episodes"
    assert summary["categories"]["cup"]["success_rate"] == 0.0
    assert summary["success_threshold_mm"] is None


def test_intervals_of_dependent_objects_are_over_episodes():
    """The interval is over episodes even if the reward is the fraction of objects that succeed."""
    chosen = dataclasses.replace(CHOSEN, scenario=Scenario(task=StackBlockPyramid()))
    episodes = [make_episode(seed, [1.0, 9.0 if seed % 2 else 1.0]) for seed in range(6)]
    summary = summarise(episodes, chosen, PoseWithin(), wall_seconds_total=1.0)
    assert summary["ci95"] == pytest.approx(mean_interval([1.0, 0.5] * 3))
    assert summary["ci95_method"] == "Student or Wilson, over episodes"
    summary = summarised(episodes)
    assert summary["ci95"] == pytest.approx(proportion_interval(9, 12))
    assert summary["ci95_method"] == "Wilson, over objects"


def test_summary_of_failed_episodes_only():
    summary = summarised([make_lost_episode(0)])
    assert summary["success_rate"] == 0.0
    assert summary["add_s_mm"]["median"] is None
    assert list(summary["categories"]) == ["unknown"]
    assert summary["causes"]["failed episode"] == 1


def test_an_arms_limits_and_collisions_over_all_episodes():
    shares = {"position": 0.5, "velocity": 0.9, "acceleration": 1.0, "jerk": 0.1, "torque": 0.3}
    uses = [
        {**shares, "collisions": []},
        {**shares, "torque": 0.4, "collisions": ["link6 and kit"]},
    ]
    episodes = [make_episode(seed, [1.0]) | {"arm": use} for seed, use in enumerate(uses)]
    found = summarised(episodes)["arm"]
    assert found == {**shares, "torque": 0.4, "collisions": {"link6 and kit": 1}}
    assert summarised([make_episode(0, [1.0])])["arm"] is None
