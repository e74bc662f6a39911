"""Counts the actions that a policy's memory of failed grasps can have changed.

Policies do not pick within 10 mm of a failed grasp of the same episode, unless `avoid_failed_picks`
is false. The policies of the paper have no such memory. The memory can only change actions that
come after the first failed grasp of an episode. Newer summaries count these actions; for older ones
this module gives bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result
from kitting_drake.reproduction.paper.cells import TASKS, Training

_MOST_ACTIONS = {
    "!AlignBoxCorner": 3,
    "!BlockInsertion": 3,
    "!PlaceRedInGreen": 10,
    "!PalletizingBoxes": 30,
    "!StackBlockPyramid": 12,
}
"""The largest number of actions of an episode, by task, for runs whose summaries do not count their
actions. On any other task, an episode has at most one action per object."""


@dataclass(frozen=True)
class Changeable:
    """The number of actions that the memory of failed grasps can have changed is between `at_least`
    and `at_most`. The number of all actions is `actions`."""

    at_least: int
    at_most: int
    actions: int

    def __add__(self, other: Changeable) -> Changeable:
        return Changeable(
            self.at_least + other.at_least,
            self.at_most + other.at_most,
            self.actions + other.actions,
        )

    @property
    def text(self) -> str:
        """The counts as text, such as "2 of 10" or "1 to 3 of 10"."""
        if self.at_least == self.at_most:
            return f"{self.at_most} of {self.actions}"
        return f"{self.at_least} to {self.at_most} of {self.actions}"


def changeable(summary: Mapping[str, Any]) -> Changeable:
    """Counts the actions after a failed grasp of the same episode, or gives bounds on their number.

    Newer summaries have this count. An older one has only the number F of failed grasps in E
    episodes. At most n = min(F, E) of these episodes have a failed grasp. This gives two bounds:

    - At least F - n actions follow a failed grasp: in each episode, every failed grasp except the
      first follows an earlier one.
    - The number of actions after a failed grasp is largest if n episodes begin with a failed grasp.
      The other episodes need at least one action for each placed object. So the bound is the number
      of all actions, minus n, minus the least number of objects placed in any E - n episodes. The
      bound is also at most the number of actions that the task allows in n episodes, minus n.

    Args:
        summary: the summary that `evaluate` wrote for a learned policy. If it has no number of
            actions, each episode is assumed to have used as many as the task allows.
    """
    episodes = [item["objects"] for item in summary["outcomes"]]
    tag = summary["resolved_scenario"]["task"]["_tag"]
    most = [_MOST_ACTIONS.get(tag, len(objects)) for objects in episodes]
    actions = summary.get("actions", sum(most))
    if not summary["policy_details"].get("avoid_failed_picks", True):
        return Changeable(0, 0, actions)
    counted = summary.get("actions_after_failed_grasps")
    if counted is not None:
        return Changeable(counted, counted, actions)
    failed = summary["missed_grasps"] + summary["dropped_objects"]
    if not failed:
        return Changeable(0, 0, actions)
    with_failure = min(failed, len(episodes))
    placed = sorted(max(1, sum(end > 0 for end in objects.values())) for objects in episodes)
    others = placed[: len(episodes) - with_failure]
    at_most = min(
        actions - sum(others) - with_failure,
        sum(sorted(most)[-with_failure:]) - with_failure,
    )
    return Changeable(failed - with_failure, at_most, actions)


def failed_grasps(results: Sequence[Result]) -> list[str]:
    """Writes the section on failed grasps: a row for each task and method.

    Each row is a sum over the cells with the paper's settings.
    """
    sums: dict[tuple[str, str], list[Changeable]] = {}
    for result in results:
        if is_as_in_the_paper(result):
            assert isinstance(result.cell.policy, Training)
            key = (result.cell.task, result.cell.policy.method)
            sums.setdefault(key, []).append(changeable(result.summary))
    if not sums:
        return []
    rows = []
    for task in TASKS:
        found = {method: sums[task, method] for method in LEARNED if (task, method) in sums}
        for method, cells in found.items():
            total = sum(cells[1:], cells[0])
            unchanged = sum(not cell.at_most for cell in cells)
            share = f"{100 * total.at_most / total.actions:.0f} %"
            rows.append([task, METHODS[method], str(len(cells)), str(unchanged), total.text, share])
    headings = ["task", "method", "cells", "cells without failed grasps"]
    headings += ["actions after a failed grasp, of all actions", "their largest possible share"]
    return [
        "### The memory of failed grasps\n",
        prose("failed_grasps"),
        markdown_table(headings, rows, left_columns=2),
    ]


def is_as_in_the_paper(result: Result) -> bool:
    """Whether a result comes from a learned policy under the paper's conditions: actions are
    quantized, and episodes end at success."""
    cell = result.cell
    return isinstance(cell.policy, Training) and cell.end_at_success and not cell.continuous
