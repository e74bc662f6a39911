"""What many episodes come to: `summary.json` and its table."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from kitting_drake.episode.action_log import CAUSES
from kitting_drake.hkd.tools.tool import CATEGORIES
from kitting_drake.scenario.command_line import ChosenScenario, versions
from kitting_drake.scenario.policies import describe_learned
from kitting_drake.scenario.schema import (
    ArrangedKitting,
    Kitting,
    Learned,
    Oracle,
    PythonPolicy,
    QuantisedOracle,
    ToolsetKitting,
)

Episode = dict[str, Any]
"""A line of `episodes.jsonl`: what `EpisodeResult.as_dict` gives."""

Entry = dict[str, Any]
"""An object or an action of an episode."""

SEEN_TASK = "kitting-seen-toolset"
UNSEEN_TASK = "kitting-unseen-toolsets"
"""The tasks of the paper (section V-B.1)."""

FAILED = "failed episode"
"""The cause of all objects of an episode that failed."""

DOUBTS = {"proud": ("height_error_mm", 2.0), "turned": ("angle_error_deg", 20.0)}
"""Why a success may not be one to a person: an error that ADD-S forgives, and beyond what it is
counted. Proud: it stands so far above (or below) its seat. Turned: it lies so far round, which for
a tool whose two ends are alike means nothing."""

ERRORS = ("add_s_mm", "position_error_mm", "angle_error_deg", "height_error_mm")
"""Of an object where it ended."""

ANSWER_ERRORS = (
    "pick_position_error_mm",
    "pick_angle_error_deg",
    "place_position_error_mm",
    "place_angle_error_deg",
)
"""Of what a policy answered; see `kitting_drake.episode.action_log.ActionRecord`."""


def summarise(
    episodes: list[Episode], chosen: ChosenScenario, *, wall_seconds_total: float
) -> dict[str, Any]:
    """What `summary.json` holds.

    The success rate is the mean of the episodes' scores, failed episodes counting 0. Its interval
    is Wilson's, over as many trials as there were objects. Error statistics are over all objects,
    and all actions, of the episodes that did not fail, missed ones included.

    Args:
        episodes: at least one.
        chosen: what was run.
        wall_seconds_total: how long the verb took, in s; `wall_seconds` adds up the episodes'.
    """
    rate = float(np.mean([episode["success_rate"] for episode in episodes]))
    whole = [episode for episode in episodes if not episode["failure"]]
    failed = len(episodes) - len(whole)
    objects = [item for episode in whole for item in episode["objects"]]
    actions = [item for episode in whole for item in episode["actions_taken"]]
    # What a failed episode held is the most that any held: one whose process died cannot tell.
    held = [Counter(item["category"] for item in episode["objects"]) for episode in episodes]
    per_episode = {name: max(count[name] for count in held) for name in CATEGORIES}
    everything = max(sum(per_episode.values()), 1)
    return {
        "scenario": chosen.name,
        "task": task_name(chosen.scenario.task),
        "policy": chosen.policy,
        "scenario_text": chosen.text,
        "versions": versions(),
        "policy_details": policy_details(chosen.scenario.policy, chosen.base),
        "success_threshold_mm": 1e3 * chosen.scenario.task.success_threshold,
        "seeds": [episode["seed"] for episode in episodes],
        "episodes": len(episodes),
        "failed_episodes": failed,
        "success_rate": rate,
        "ci95": wilson_interval(rate, len(episodes) * everything),
        **_statistics(objects, actions, failed * everything),
        "categories": {
            name: _summarise_category(name, objects, actions, failed * per_episode[name])
            for name in CATEGORIES
            if per_episode[name]
        },
        "missed_grasps": sum(episode["missed_grasps"] for episode in episodes),
        "dropped_objects": sum(episode["dropped_objects"] for episode in episodes),
        "point_contact_pairs": max(episode["point_contact_pairs"] for episode in episodes),
        "sim_seconds": sum(episode["sim_seconds"] for episode in episodes),
        "wall_seconds": sum(episode["wall_seconds"] for episode in episodes),
        "wall_seconds_total": wall_seconds_total,
    }


def task_name(task: Kitting | ToolsetKitting | ArrangedKitting) -> str:
    """The paper's name of a task, where it has one: where nothing in it was changed."""
    if task == Kitting():
        return SEEN_TASK
    if task == ToolsetKitting(split="test"):
        return UNSEEN_TASK
    if task == ToolsetKitting(split="train"):
        return "kitting-train-toolsets"
    return "arranged" if isinstance(task, ArrangedKitting) else "kitting"


def policy_details(
    policy: Oracle | QuantisedOracle | Learned | PythonPolicy, base: Path
) -> dict[str, Any] | None:
    """What tells one policy from another of its kind; None if nothing is known."""
    if isinstance(policy, Oracle):
        return {"method": "oracle"}
    if isinstance(policy, QuantisedOracle):
        return {"method": "quantised_oracle", "orientations": policy.orientations}
    if isinstance(policy, Learned):
        return describe_learned(policy, base=base)
    return None


def _summarise_category(
    category: str, objects: list[Entry], actions: list[Entry], failed: int
) -> dict[str, Any]:
    """As the summary of all, for the objects of one category."""
    objects = [item for item in objects if item["category"] == category]
    actions = [item for item in actions if item["category"] == category]
    trials = len(objects) + failed
    rate = sum(item["success"] for item in objects) / trials
    return {
        "objects": trials,
        "success_rate": rate,
        "ci95": wilson_interval(rate, trials),
        **_statistics(objects, actions, failed),
    }


def _statistics(objects: list[Entry], actions: list[Entry], failed: int) -> dict[str, Any]:
    """Errors and causes; `failed` objects of failed episodes have a cause and no errors."""
    causes = Counter(item["cause"] for item in objects) + Counter({FAILED: failed})
    return {
        **{key: _spread([abs(item[key]) for item in objects]) for key in ERRORS},
        "answers": {key: _spread([item[key] for item in actions]) for key in ANSWER_ERRORS},
        "causes": {cause: causes[cause] for cause in (*CAUSES, FAILED)},
        "doubts": {
            name: sum(item["success"] and abs(item[key]) > limit for item in objects)
            for name, (key, limit) in DOUBTS.items()
        },
    }


def wilson_interval(rate: float, trials: int) -> list[float]:
    """Wilson's 95 % score interval of a proportion."""
    z = 1.959964
    centre = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials**2))
    half /= 1 + z * z / trials
    return [max(0.0, centre - half), min(1.0, centre + half)]


def _spread(values: list[float]) -> dict[str, float | None]:
    if not values:
        return {"median": None, "p95": None, "max": None}
    return {
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
    }


def summary_table(summary: dict[str, Any]) -> Table:
    """The summary for the terminal: a row for each category."""
    low, high = summary["ci95"]
    table = Table(
        title=f"{summary['scenario']} by {summary['policy']}: {summary['episodes']} episodes, "
        f"{summary['success_rate']:.1%} kitted (95 %: {low:.1%} to {high:.1%}), "
        f"{summary['failed_episodes']} failed",
        title_justify="left",
    )
    table.add_column("category", no_wrap=True)
    for heading in ("kitted", "ADD-S mm", "95 %", "position mm", "angle deg", "height mm"):
        table.add_column(heading, justify="right")
    categories = summary["categories"]
    trials = sum(row["objects"] for row in categories.values())
    for name, row in [*categories.items(), ("all", summary | {"objects": trials})]:
        if trials:
            table.add_row(
                name,
                f"{round(row['success_rate'] * row['objects'])}/{row['objects']}",
                number(row["add_s_mm"]["median"]),
                number(row["add_s_mm"]["p95"]),
                *(number(row[key]["median"]) for key in ERRORS[1:]),
            )
    return table


def summary_notes(summary: dict[str, Any]) -> str:
    """What the terminal tells below the table: why objects were lost, and what was answered."""
    causes = [f"{count} {cause}" for cause, count in summary["causes"].items() if count]
    position, angle, place_position, place_angle = (
        number(summary["answers"][key]["median"]) for key in ANSWER_ERRORS
    )
    doubts = [f"{count} {name}" for name, count in summary["doubts"].items() if count]
    return (
        f"not kitted: {', '.join(causes) or 'none'}\n"
        f"kitted, but: {', '.join(doubts) or 'none'}\n"
        f"answers, median error: pick {position} mm {angle} deg, "
        f"place {place_position} mm {place_angle} deg"
    )


def number(value: float | None) -> str:
    """For a table: two digits after the point, or a dash for what there is none of."""
    return "-" if value is None else f"{value:.2f}"
