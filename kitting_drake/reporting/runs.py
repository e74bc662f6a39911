"""The runs that the page of results is made of: files of `evaluate`, and how they depart from the
paper's tasks."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.policies.static_scenes import STATIC
from kitting_drake.reporting.summary import ERRORS
from kitting_drake.scenario.command_line import ChosenScenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import PAPER_TASKS, RAVENS_TASKS

METHODS = {
    "so2": "SO(2)-equivariant (ours)",
    "equivariant_transporter": "Equivariant Transporter",
    "transporter": "Transporter",
    "generalist": "generalist, of static scenes",
    "shape_matching": "shape matching, of nothing",
    "quantized_oracle": "oracle, quantized",
    "oracle": "oracle, exact",
}
"""Names of methods for people; any other is called as it calls itself."""

LEARNED = ("so2", "equivariant_transporter", "transporter")
"""The methods that the paper compares."""

_NOT_THE_TASK = ("policy", "random_seed", "target_realtime_rate")
"""The fields of a scenario in which runs of one task may differ."""

_ADDED = (
    "task.distractors",
    "task.tries",
    "task.pool",
    "task.kit.always_nested",
    "task.kit.fixed_size",
    "planner.firm_grasp_force",
    "planner.heavy_load",
    "planner.press_force",
    "planner.press_depth",
    "planner.search.reach",
    "planner.search.speed",
    "plant.friction_variation",
    "plant.mass_variation",
    "sensor_noise",
    "appearance",
)
"""Fields that older runs lack; their defaults change nothing in what those did, but that a search
that was in vain goes on in a spiral, and that what is heavy is gripped more firmly."""

_FORMER = {"planner.minimum_width": 0.003}
"""Defaults of older runs that are not listed as departures: with this one what is thinner than 3 mm
counted as not gripped, and no tool of the paper's tasks and no box is gripped where it is that
thin."""

_MOST_SHOWN = 4
"""So many differences of one run are listed; more are counted."""

_KEYS = (
    "task",
    "policy",
    "policy_details",
    "resolved_scenario",
    "success_description",
    "seeds",
    "episodes",
    "success_rate",
    "ci95",
    "strict_success_rate",
    "strict_ci95",
    *ERRORS,
    "action_errors",
    "causes",
    "ambiguous",
    "categories",
    "wall_seconds",
)


@dataclass(frozen=True)
class Run:
    """One summary."""

    file: str
    summary: dict[str, Any]

    def detail(self, key: str) -> Any:
        """An entry of the policy's details; None if it has no such entry."""
        return self.summary["policy_details"].get(key)

    @property
    def method(self) -> str:
        """The policy's method: a key of `METHODS`, or the policy's name."""
        if self.detail("scenario") == STATIC:
            return "generalist"
        return self.detail("method") or self.summary["policy"]

    @property
    def seeds(self) -> str:
        """The first and the last seed, for a person."""
        seeds = self.summary["seeds"]
        first, last = min(seeds), max(seeds)
        return f"{first} to {last}" if last - first + 1 == len(seeds) else f"{first} .. {last}"

    @property
    def label(self) -> str:
        """The policy and the parameters that the paper varies, for a person."""
        parts = [METHODS.get(self.method, self.method)]
        for key, text in (
            ("orientations", "N = {}"),
            (
                "demonstrations",
                f"{{}} {'scenes' if self.method == 'generalist' else 'demonstrations'}",
            ),
            ("preset", "preset {}"),
        ):
            if self.detail(key) is not None:
                parts.append(text.format(self.detail(key)))
        return ", ".join(parts)

    @cached_property
    def departures(self) -> list[str]:
        """Where its scenario differs, but for the policy, from that of the paper's task of its
        kind, or from the Ravens task; or, if the paper has none, from the default one, but for the
        task."""
        found = self.summary["resolved_scenario"]
        for task in PAPER_TASKS.values():
            expected = described(Scenario(task=task))
            if found["task"]["_tag"] == expected["task"]["_tag"]:
                return _differences(_without(found), _without(expected))
        for other in RAVENS_TASKS:
            expected = described(Scenario(task=other))
            if found["task"]["_tag"] == expected["task"]["_tag"]:
                # The longest of them has a limit of its own.
                return _differences(_without(found, "time_limit"), _without(expected, "time_limit"))
        expected = described(Scenario())
        return _differences(_without(found, "task"), _without(expected, "task"))

    @property
    def paper_task(self) -> str | None:
        """The title of the paper's task that it is a run of, where nothing but the policy differs
        from it."""
        task = self.summary["task"]
        return task if task in PAPER_TASKS and not self.departures else None

    @property
    def departures_text(self) -> str:
        """The departures in a few words."""
        shown = "; ".join(f"`{item}`" for item in self.departures[:_MOST_SHOWN])
        more = len(self.departures) - _MOST_SHOWN
        return f"{shown}; and {more} more" if more > 0 else shown


def described(scenario: Scenario) -> dict[str, Any]:
    """The scenario as JSON holds it."""
    fields = ChosenScenario(scenario, Path(), "", None).described
    return json.loads(json.dumps(fields, default=str))


def scenario_differences(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """The fields, policy aside, in which two scenarios differ, as `described` has them."""
    return _differences(_without(found), _without(expected))


def _without(scenario: dict[str, Any], *more: str) -> dict[str, Any]:
    # What older runs, which lack these fields, did.
    whole = {"end_at_success": False} | scenario
    if "sensor_noise" in whole:
        whole["sensor_noise"] = {"frames": 1} | whole["sensor_noise"]
    return {key: value for key, value in whole.items() if key not in (*_NOT_THE_TASK, *more)}


def _differences(found: Any, expected: Any, path: str = "") -> list[str]:
    """The fields, by their paths, in which JSON values differ, with what was found there."""
    if found == expected:
        return []
    if not isinstance(found, Mapping) or not isinstance(expected, Mapping):
        return [f"{path}: {json.dumps(found)}"]
    if found.get("_tag") != expected.get("_tag"):
        return [f"{path}: {found.get('_tag')}"]
    differences = []
    for key in dict.fromkeys((*expected, *found)):
        here = f"{path}.{key}" if path else key
        if key not in found and here in _ADDED:
            continue
        if here in _FORMER and found.get(key) == _FORMER[here]:
            continue
        if key not in found:
            differences.append(f"{here}: not there")
        elif key not in expected:
            differences.append(f"{here}: {json.dumps(found[key])}")
        else:
            differences += _differences(found[key], expected[key], here)
    return differences


def read_runs(folder: Path) -> list[Run]:
    """The summaries of a folder, in the order of the names of their files; there may be none.

    Raises:
        UserError: there is no such folder, or a file in it is not what `evaluate` writes.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}: make it, and copy summary.json files there")
    return [Run(path.name, _read_summary(path)) for path in sorted(folder.glob("*.json"))]


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    for key in _KEYS:
        if not isinstance(summary, dict) or key not in summary:
            raise UserError(f"{path} lacks '{key}': it must be a summary.json of evaluate")
    if not summary["seeds"]:
        raise UserError(f"{path} has no seeds: it must be a summary.json of evaluate")
    if not isinstance(summary["resolved_scenario"].get("task"), dict):
        raise UserError(f"{path}: resolved_scenario has no task")
    _check_details(summary["policy_details"], f"{path}: policy_details")
    return summary


def _check_details(details: Any, where: str) -> None:
    if not isinstance(details, dict):
        raise UserError(f"{where} must be a mapping")
    method = details.get("method")
    needed = ["orientations"] if method in (*LEARNED, "quantized_oracle") else []
    if method in LEARNED:
        needed.append("demonstrations")
    for key in needed:
        if not isinstance(details.get(key), int):
            raise UserError(f"{where}.{key} must be a whole number for the method {method}")
