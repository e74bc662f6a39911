"""The runs behind the pages of results, and how they differ from the paper's tasks."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.summary import ERRORS
from kitting_drake.policies.data.static_scenes import STATIC
from kitting_drake.reproduction.page.run_table import TABLE, Summary, read_summaries
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import PAPER_TASKS, RAVENS_TASKS

METHODS = {
    "so2": "SO(2)-equivariant (ours)",
    "equivariant_transporter": "Equivariant Transporter",
    "transporter": "Transporter",
    "generalist": "generalist",
    "shape_matching": "shape matching",
    "quantized_oracle": "oracle, quantized",
    "oracle": "oracle, exact",
}
"""The names of methods in tables. Other methods keep their own names."""

LEARNED = ("so2", "equivariant_transporter", "transporter")
"""The methods that the paper compares."""

_NOT_THE_TASK = ("policy", "random_seed", "target_realtime_rate", "meshcat")
"""The fields of a scenario in which runs of one task may differ."""

_ADDED: dict[str, Any] = {
    "task.kit.clearance_of": {},
    "task.kit.stand_out": 0.0,
    "task.cavities": [],
    "task.distractors": 0,
    "task.tries": 1,
    "task.pool": [],
    "task.count": 0,
    "task.tool_mass": [0.0, 0.0],
    "task.kits": 1,
    "task.riser": [0.0, 0.0],
    "task.tilt_deg": [0.0, 0.0],
    "task.start": "apart",
    "task.tray": False,
    "task.faces": "as_drawn",
    "task.kit.always_nested": False,
    "task.kit.fixed_size": False,
    "sensor_noise.frames": 1,
    "sensor_noise.rig_height_error": 0.0,
    "end_at_success": False,
}
"""Fields that the summaries of older versions lack, with the values that those versions used."""

_ADDED_WHOLE = ("sensor_noise", "appearance")
"""Fields that the summaries of older versions lack. Those versions used the defaults."""

_HAND = (
    "planner.firm_grasp_force",
    "planner.heavy_load",
    "planner.press_force",
    "planner.press_depth",
    "planner.search.reach",
    "planner.search.speed",
)
_EARLIER_HAND = "an earlier hand"
"""The label of runs whose summaries lack the fields `_HAND`. In these runs the hand did not grip
heavy objects more firmly, press objects down or search in a spiral. Grasps narrower than 3 mm
counted as failed."""

_UNLIMITED_HAND = {"lower_speed": 0.08, "minimum_width": 0.0015}
"""The planner's defaults in older versions, in which contact forces did not end actions."""

_LIMITED_HAND = (
    "peak_grasp_force",
    "heaviest_load",
    "force_limit",
    "contact_speed",
    "touch_speed",
    "slow_margin",
)
"""Fields of the planner that older versions, without a limit on contact forces, did not write.
Their runs are compared as if with the present defaults; the page of results counts them."""

_MOST_SHOWN = 4
"""The largest number of differences of one run that are listed. Further ones are only counted."""


_KINDS: dict[str, Any] = {
    **dict.fromkeys(("task", "policy", "success_description"), str),
    **dict.fromkeys(("policy_details", "resolved_scenario", *ERRORS, "action_errors"), dict),
    **dict.fromkeys(("causes", "ambiguous", "categories", "versions"), dict),
    **dict.fromkeys(("seeds", "ci95", "strict_ci95"), list),
    **dict.fromkeys(("success_rate", "strict_success_rate", "wall_seconds"), int | float),
    "episodes": int,
}
"""The fields of a summary and their types."""


@dataclass(frozen=True)
class Run:
    """A run of `evaluate`."""

    name: str
    summary: Summary

    def detail(self, key: str) -> Any:
        """Returns an entry of the policy's details; None if it is missing."""
        return self.summary["policy_details"].get(key)

    @property
    def method(self) -> str:
        """The policy's method: a key of `METHODS`, or the policy's name."""
        if self.detail("scenario") == STATIC:
            return "generalist"
        return self.detail("method") or self.summary["policy"]

    @property
    def seeds(self) -> str:
        """The first and the last seed, as text."""
        seeds = self.summary["seeds"]
        first, last = min(seeds), max(seeds)
        return f"{first} to {last}" if last - first + 1 == len(seeds) else f"{first} .. {last}"

    @property
    def label(self) -> str:
        """The policy, and the parameters that the paper varies, as text."""
        parts = [METHODS.get(self.method, self.method)]
        examples = "scene" if self.method == "generalist" else "demonstration"
        if str(self.detail("demonstrations")) != "1":
            examples += "s"
        for key, text in (
            ("orientations", "N = {}"),
            ("demonstrations", f"{{}} {examples}"),
            ("preset", "preset {}"),
        ):
            if self.detail(key) is not None:
                parts.append(text.format(self.detail(key)))
        return ", ".join(parts)

    @cached_property
    def departures(self) -> list[str]:
        """The fields in which the run's scenario differs from the expected scenario, except the
        policy.

        For a task of the paper, including its Ravens tasks, the expected scenario is this project's
        scenario for the task. For any other task it is the default scenario, and the task is not
        compared.
        """
        found = self.summary["resolved_scenario"]
        for task in PAPER_TASKS.values():
            expected = described(Scenario(task=task))
            if found["task"]["_tag"] == expected["task"]["_tag"]:
                return _differences(_without(found), _without(expected))
        for expected in _ravens_scenarios():
            if found["task"]["_tag"] == expected["task"]["_tag"]:
                return _differences(_without(found), _without(expected))
        expected = _defaults()
        return _differences(_without(found, "task"), _without(expected, "task"))

    @property
    def paper_task(self) -> str | None:
        """The title of the task, if it is a task of the paper and the run's scenario differs at
        most in the policy; otherwise None."""
        task = self.summary["task"]
        return task if task in PAPER_TASKS and not self.departures else None

    @property
    def departures_text(self) -> str:
        """The departures as short text."""
        shown = "; ".join(f"`{item}`" for item in self.departures[:_MOST_SHOWN])
        more = len(self.departures) - _MOST_SHOWN
        return f"{shown}; and {more} more" if more > 0 else shown


def described(scenario: Scenario) -> dict[str, Any]:
    """Returns a scenario as JSON values."""
    fields = ChosenScenario(scenario, Path(), "", None).described
    return json.loads(json.dumps(fields, default=str))


def scenario_differences(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Returns the fields in which two scenarios (see `described`) differ, except the policy."""
    return _differences(_without(found), _without(expected))


def _without(scenario: dict[str, Any], *more: str) -> dict[str, Any]:
    # Older versions did not write the field `robot`. They used the default, the floating hand.
    fields = {"robot": _defaults()["robot"]} | scenario | _translated(scenario.get("plant"))
    if has_unlimited_hand(fields):
        fields["planner"] = _with_present_hand(fields["planner"])
    return {key: value for key, value in fields.items() if key not in (*_NOT_THE_TASK, *more)}


def has_unlimited_hand(scenario: Mapping[str, Any]) -> bool:
    """Whether a scenario (see `described`) has no limit on contact forces. This is so only in
    runs of older versions."""
    planner = scenario.get("planner")
    return isinstance(planner, dict) and "force_limit" not in planner


def _with_present_hand(planner: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields of an older run's planner, updated for comparison with present runs.

    Missing fields (`_LIMITED_HAND`) are added with the present defaults. Fields that have the older
    defaults (`_UNLIMITED_HAND`) get the present ones.
    """
    defaults = _defaults()["planner"]
    former = [key for key, value in _UNLIMITED_HAND.items() if planner.get(key) == value]
    return planner | {key: defaults[key] for key in (*_LIMITED_HAND, *former)}


def _translated(plant: Any) -> dict[str, Any]:
    """Renames the fields of `plant` in a run of an older version to their present names."""
    if not isinstance(plant, dict) or "contact_approximation" not in plant:
        return {}
    defaults = _defaults()
    return {
        "plant": defaults["plant"]
        | {
            "time_step": plant["time_step"],
            "discrete_contact_approximation": plant["contact_approximation"],
        },
        "variation": defaults["variation"]
        | {key: plant.get(f"{key}_variation", 0.0) for key in ("friction", "mass")},
    }


@cache
def _ravens_scenarios() -> list[dict[str, Any]]:
    names = [type(task).__name__ for task in RAVENS_TASKS]
    return [described(load_scenario(SCENARIOS / "ravens.yaml", name)) for name in names]


@cache
def _defaults() -> dict[str, Any]:
    return described(Scenario())


@cache
def _added() -> dict[str, Any]:
    return _ADDED | {key: _defaults()[key] for key in _ADDED_WHOLE}


def _differences(found: Any, expected: Any, path: str = "") -> list[str]:
    """Returns the paths at which JSON values differ, with the values found there."""
    if found == expected:
        return []
    if not isinstance(found, Mapping) or not isinstance(expected, Mapping):
        return [f"{path}: {json.dumps(found)}"]
    if found.get("_tag") != expected.get("_tag"):
        return [f"{path}: {found.get('_tag')}"]
    differences = []
    for key in dict.fromkeys((*expected, *found)):
        here = f"{path}.{key}" if path else key
        if key not in found and here in _HAND:
            differences.append(_EARLIER_HAND)
        elif key not in found and here not in _added():
            differences.append(f"{here}: not there")
        elif key not in expected:
            differences.append(f"{here}: {json.dumps(found[key])}")
        else:
            was = found[key] if key in found else _added()[here]
            differences += _differences(was, expected[key], here)
    return list(dict.fromkeys(differences))


def read_runs(folder: Path) -> list[Run]:
    """Returns all runs in a folder's table, sorted by name; the table may be empty.

    Raises:
        UserError: there is no table, a file is damaged, or a run is not from `evaluate`.
    """
    if not (folder / TABLE).exists():
        raise UserError(
            f"there is no {folder / TABLE}: add a run to it, with `results --add NAME FOLDER`"
        )
    summaries = read_summaries(folder)
    for name, summary in summaries.items():
        check_summary(summary, f"{folder / TABLE}, run '{name}'")
    return [Run(name, summary) for name, summary in summaries.items()]


def read_evaluation(path: Path) -> Summary:
    """Returns the summary that `evaluate` wrote.

    Args:
        path: the file, or the folder with its `summary.json`.

    Raises:
        UserError: the file is unreadable or not a summary.
    """
    path = path / "summary.json" if path.is_dir() else path
    try:
        summary = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} cannot be read ({error}): give the output folder of evaluate"
        ) from error
    check_summary(summary, str(path))
    return summary


def check_summary(summary: Any, where: str) -> None:
    """Checks that a summary has the fields of `evaluate`, with their types.

    Args:
        summary: the content of a file, or of a row.
        where: the file and the run of the summary, for the error message.

    Raises:
        UserError: a field is missing or of another type.
    """
    must = "it must be a summary.json of evaluate"
    for key, kind in _KINDS.items():
        if not isinstance(summary, dict) or key not in summary:
            raise UserError(f"{where} lacks '{key}': {must}")
        if not isinstance(summary[key], kind) or summary[key] == []:
            raise UserError(
                f"{where}: '{key}' is empty or of the wrong type ({summary[key]!r}): {must}"
            )
    task = summary["resolved_scenario"].get("task")
    if not isinstance(task, dict) or "_tag" not in task:
        raise UserError(f"{where}: resolved_scenario has no task: {must}")
    details = summary["policy_details"]
    method = details.get("method")
    needed = ["orientations"] if method in (*LEARNED, "quantized_oracle") else []
    if method in LEARNED:
        needed.append("demonstrations")
    for key in needed:
        if not isinstance(details.get(key), int):
            raise UserError(
                f"{where}: policy_details.{key} must be a whole number for the method {method}"
            )
