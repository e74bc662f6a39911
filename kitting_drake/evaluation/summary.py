"""Computes the summary of many episodes that `summary.json` holds."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kitting_drake.common.provenance import commit, versions
from kitting_drake.evaluation.intervals import mean_interval, proportion_interval
from kitting_drake.scenario.choosing import ChosenScenario
from systems.placement import STRICT_ANGLE, STRICT_HEIGHT, SuccessPredicate
from systems.success import AddS

Episode = dict[str, Any]
"""A line of `episodes.jsonl`: the result of `EpisodeResult.as_dict`."""

Entry = dict[str, Any]
"""An object or an action in the result of an episode."""

FAILED = "failed episode"
"""The cause of failure of all objects of an episode that ended with an error."""
TIMED_OUT = "timed out"
"""The cause of failure of all objects of an episode that reached the time limit."""

UNKNOWN = "unknown"
"""If no episode lists its objects, a failed episode counts as one object of this category."""

AMBIGUITIES = {
    "protruding": ("height_error_mm", 1e3 * STRICT_HEIGHT),
    "reversed": ("angle_error_deg", math.degrees(STRICT_ANGLE)),
}
"""Reasons why a success is not strict. Each is an error that the task's success predicate
tolerates, with the limit for a strict success. The angle is modulo the object's declared
symmetry."""

_FAILED_GRASPS = ("missed", "dropped", "stopped")
"""The outcomes of actions that count as failed grasps: the grasp was missed or lost, or the force
guard stopped the action."""
_MOVES = ("placed", "dropped", "stopped", "set down")
"""The outcomes of actions that may have moved an object."""

ERRORS = ("add_s_mm", "position_error_mm", "angle_error_deg", "height_error_mm")
"""Keys of the errors of an object's final pose."""

ACTION_ERRORS = (
    "pick_position_error_mm",
    "pick_angle_error_deg",
    "place_position_error_mm",
    "place_angle_error_deg",
)
"""The errors of a policy's action; see `kitting_drake.tasks.task.ActionRecord`."""


def summarise(
    episodes: Sequence[Episode],
    chosen: ChosenScenario,
    success: SuccessPredicate,
    *,
    wall_seconds_total: float,
) -> dict[str, Any]:
    """Computes the content of `summary.json`.

    - Rates are means of the episodes' rewards; failed and timed-out episodes count 0.
    - If the reward is the share of successful objects, and the task declares its objects
      independent, intervals are Wilson's over objects. Otherwise (partial rewards, weights, stacks)
      they are over episodes, see `mean_interval`. `ci95_method` names the method.
    - `outcomes` holds the seed, the success rate and the strict success rate of each episode. For
      each object it holds 2 (strict success), 1 (success) or 0 (failure). It allows paired
      comparisons of runs with the same seeds.
    - Errors include all objects and actions of completed episodes, also failed objects and actions.
      Objects for which no goal was left are excluded.
    - `measures` holds, for each further measure of the task, the share of objects that succeed by
      it.

    Args:
        episodes: at least one episode.
        chosen: the scenario.
        success: the success predicate of the scenario's scenes.
        wall_seconds_total: total duration of the calls that ran the episodes, in s. In contrast,
            `wall_seconds` is the sum of the episodes' durations.
    """
    objects_of = counted_objects(episodes)
    objects = [item for items in objects_of for item in items]
    actions = counted_actions(episodes)
    categories = sorted({item["category"] for item in objects})
    policy, causes = chosen.scenario.policy, (*chosen.scenario.task.causes, FAILED, TIMED_OUT)
    return {
        "scenario": chosen.name,
        "task": chosen.scenario.task.title,
        "policy": chosen.policy,
        "policy_details": policy.details(chosen.base),
        "policy_digest": policy.digest(chosen.base),
        "success_description": success.description,
        "success_threshold_mm": 1e3 * success.threshold if isinstance(success, AddS) else None,
        "seeds": [episode["seed"] for episode in episodes],
        "episodes": len(episodes),
        "failed_episodes": sum(bool(episode["failure"]) for episode in episodes),
        "timed_out_episodes": sum(episode["timed_out"] for episode in episodes),
        "stop_reasons": _stop_reasons(episodes),
        **_rates(episodes, objects_of, chosen.scenario.task.objects_are_independent),
        "measures": _measures(objects),
        **_statistics(objects, actions, causes),
        "categories": {
            name: _summarise_category(
                [item for item in objects if item["category"] == name],
                [item for item in actions if item["category"] == name],
                causes,
            )
            for name in categories
        },
        "outcomes": [
            _outcome(episode, objects)
            for episode, objects in zip(episodes, objects_of, strict=True)
        ],
        "actions": sum(episode["actions"] for episode in episodes),
        "needless_actions": sum(needless_actions(episode) for episode in episodes),
        "repeated_moves": sum(repeated_moves(episode) for episode in episodes),
        "actions_after_failed_grasps": sum(map(actions_after_failed_grasp, episodes)),
        "missed_grasps": sum(episode["missed_grasps"] for episode in episodes),
        "dropped_objects": sum(episode["dropped_objects"] for episode in episodes),
        "stopped_actions": sum(episode.get("stopped_actions", 0) for episode in episodes),
        "peak_force_n": _describe(peak_forces(episodes), "force"),
        "arm": _arm_use([episode["arm"] for episode in episodes if episode.get("arm")]),
        "moving_at_end": sum(len(episode["moving_at_end"]) for episode in episodes),
        "point_contact_pairs": max(episode["point_contact_pairs"] for episode in episodes),
        "sim_seconds": sum(episode["sim_seconds"] for episode in episodes),
        "wall_seconds": sum(episode["wall_seconds"] for episode in episodes),
        "wall_seconds_total": wall_seconds_total,
        "versions": versions(),
        "commit": _commits(episodes),
        "resolved_scenario": chosen.described,
    }


def _commits(episodes: Sequence[Episode]) -> str | None:
    """The commits of the code that ran the episodes. There are several if the evaluation was
    resumed with other code. If no episode has a commit, the commit of the present code is
    returned."""
    found = dict.fromkeys(str(episode["commit"]) for episode in episodes if episode.get("commit"))
    return ", ".join(found) or commit()


def _stop_reasons(episodes: Sequence[Episode]) -> dict[str, dict[str, int]]:
    """How often each reason for stopping was right and wrong; see
    `kitting_drake.episode.ending`."""
    found: dict[str, dict[str, int]] = {}
    for episode in episodes:
        verdict = episode.get("stop_reason_right")
        if verdict is not None:
            counts = found.setdefault(episode["stop_reason"], {"right": 0, "wrong": 0})
            counts["right" if verdict else "wrong"] += 1
    return found


def _arm_use(uses: Sequence[Entry]) -> dict[str, Any] | None:
    """The largest share of each limit that the arm used in any episode, and the number of episodes
    in which each pair of bodies collided; None without an arm. See `ArmUse`."""
    if not uses:
        return None
    collisions = Counter(pair for use in uses for pair in use["collisions"])
    shares = {key: max(use[key] for use in uses) for key in uses[0] if key != "collisions"}
    return {**shares, "collisions": dict(collisions)}


def peak_forces(episodes: Sequence[Episode]) -> list[Entry]:
    """An entry for each action with recorded forces. Its `force` is the larger of the action's
    vertical and lateral peak force, in N."""
    peaks = [
        action.get("peak_force_n") for episode in episodes for action in episode["actions_taken"]
    ]
    return [{"force": max(peak["vertical"], peak["lateral"])} for peak in peaks if peak]


def needless_actions(episode: Episode) -> int:
    """The number of actions on objects for which no goal was left.

    Success rates do not count these objects, but moving them may disturb other objects.
    """
    useful = {item["name"] for item in episode["objects"] if item["add_s_mm"] is not None}
    if not useful:
        # The result of a failed episode may have no objects.
        return 0
    return sum(action["object"] not in useful for action in episode["actions_taken"])


def repeated_moves(episode: Episode) -> int:
    """The number of actions that may have moved an object although it was placed, with strict
    success."""
    return sum(
        action.get("was_placed", False) and action["outcome"] in _MOVES
        for action in episode["actions_taken"]
    )


def actions_after_failed_grasp(episode: Episode) -> int:
    """The number of actions after the episode's first failed grasp. In these actions a policy with
    a memory of failed grasps may decide differently."""
    outcomes = [action["outcome"] for action in episode["actions_taken"]]
    failed = [index for index, outcome in enumerate(outcomes) if outcome in _FAILED_GRASPS]
    return len(outcomes) - 1 - failed[0] if failed else 0


def counted_objects(episodes: Sequence[Episode]) -> list[list[Entry]]:
    """The objects of each episode that count: those for which a goal was left.

    In a failed or timed-out episode no object is a success or has errors. If the episode's process
    died, its objects may be unknown. Such an episode gets failed objects: in each category, the
    largest number in any episode.
    """
    found = [
        [item for item in episode["objects"] if item["add_s_mm"] is not None]
        for episode in episodes
    ]
    most: Counter[str] = Counter()
    for objects in found:
        most |= Counter(item["category"] for item in objects)
    usual = list(most.elements()) or [UNKNOWN]
    return [
        objects if cause is None else _lost(objects, usual, cause)
        for objects, cause in zip(found, map(_lost_cause, episodes), strict=True)
    ]


def _outcome(episode: Episode, objects: list[Entry]) -> dict[str, Any]:
    """The element of the summary's `outcomes` for one episode. Objects whose names are unknown,
    because the episode's process died, are left out."""
    return {key: episode[key] for key in ("seed", "success_rate", "strict_success_rate")} | {
        "objects": {
            item["name"]: int(item["success"]) + int(item["strict_success"])
            for item in objects
            if "name" in item
        }
    }


def _lost(objects: list[Entry], usual: list[str], cause: str) -> list[Entry]:
    known = [{key: item[key] for key in ("name", "category")} for item in objects]
    return [
        {**item, "success": False, "strict_success": False, "cause": cause, **dict.fromkeys(ERRORS)}
        for item in known or [{"category": name} for name in usual]
    ]


def _lost_cause(episode: Episode) -> str | None:
    if episode["failure"]:
        return FAILED
    return TIMED_OUT if episode["timed_out"] else None


def counted_actions(episodes: Sequence[Episode]) -> list[Entry]:
    """The actions of completed episodes: failed and timed-out episodes are left out."""
    return [
        action
        for episode in episodes
        if _lost_cause(episode) is None
        for action in episode["actions_taken"]
    ]


def _rates(
    episodes: Sequence[Episode], objects_of: list[list[Entry]], are_independent: bool
) -> dict[str, Any]:
    """The rates of successes and of strict successes, with their intervals."""
    scores, strict_scores = (
        [float(episode[key]) for episode in episodes]
        for key in ("success_rate", "strict_success_rate")
    )
    counts, strict_counts = (
        [sum(item[key] for item in objects) for objects in objects_of]
        for key in ("success", "strict_success")
    )
    sizes = [len(objects) for objects in objects_of]
    over_objects = (
        are_independent
        and len(set(sizes)) == 1
        and sizes[0] > 0
        and np.allclose([scores, strict_scores], np.array([counts, strict_counts]) / sizes[0])
    )

    def interval(scores: list[float], counts: list[int]) -> list[float]:
        if over_objects:
            return proportion_interval(sum(counts), sum(sizes))
        return mean_interval(scores)

    method = "Wilson, over objects" if over_objects else "Student or Wilson, over episodes"
    return {
        "success_rate": float(np.mean(scores)),
        "ci95": interval(scores, counts),
        "strict_success_rate": float(np.mean(strict_scores)),
        "strict_ci95": interval(strict_scores, strict_counts),
        "ci95_method": method,
    }


def _measures(objects: Sequence[Entry]) -> dict[str, dict[str, Any]]:
    """The success rates by the task's other measures. An object without a recorded result is not a
    success by any measure."""
    names = dict.fromkeys(name for item in objects for name in item.get("measures") or {})
    counts = {
        name: sum((item.get("measures") or {}).get(name, False) for item in objects)
        for name in names
    }
    return {
        name: {
            "success_rate": count / len(objects),
            "ci95": proportion_interval(count, len(objects)),
        }
        for name, count in counts.items()
    }


def _summarise_category(
    objects: list[Entry], actions: list[Entry], causes: Sequence[str]
) -> dict[str, Any]:
    """The summary of the objects of one category; rates are shares of the objects."""
    successes, strict_successes = (
        sum(item[key] for item in objects) for key in ("success", "strict_success")
    )
    return {
        "objects": len(objects),
        "success_rate": successes / len(objects),
        "ci95": proportion_interval(successes, len(objects)),
        "strict_success_rate": strict_successes / len(objects),
        "strict_ci95": proportion_interval(strict_successes, len(objects)),
        "measures": _measures(objects),
        **_statistics(objects, actions, causes),
    }


def _statistics(
    objects: list[Entry], actions: list[Entry], causes: Sequence[str]
) -> dict[str, Any]:
    found = Counter(item["cause"] for item in objects if item["cause"] is not None)
    ambiguous = Counter(name for item in objects for name in find_ambiguities(item))
    return {
        **{key: _describe(objects, key) for key in ERRORS},
        "action_errors": {key: _describe(actions, key) for key in ACTION_ERRORS},
        "causes": {cause: found[cause] for cause in dict.fromkeys((*causes, *found))},
        "ambiguous": {name: ambiguous[name] for name in AMBIGUITIES},
    }


def find_ambiguities(item: Mapping[str, Any]) -> list[str]:
    """The names, in `AMBIGUITIES`, of the reasons why a success is not strict."""
    if not item["success"] or item["strict_success"]:
        return []
    return [name for name, (key, limit) in AMBIGUITIES.items() if abs(item[key]) > limit]


def _describe(items: list[Entry], key: str) -> dict[str, float | None]:
    """Returns the median, the 95th percentile and the maximum of the magnitudes of the items'
    values under a key. Values that are None are left out."""
    values = [abs(item[key]) for item in items if item[key] is not None]
    if not values:
        return {"median": None, "p95": None, "max": None}
    return {
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
    }
