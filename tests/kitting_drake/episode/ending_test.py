import dataclasses
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from kitting_drake.episode.ending import Position, find_left_over, is_right
from systems.placement import Goal, PlacedObject, Placement
from systems.signals import Attempt, LeftOver, PickPlaceAction

STOP = PickPlaceAction(stop=True, reason="done")
POINTS = np.array([[0.0, 0.0, 0.0], [0.02, 0.02, 0.02]])


@dataclasses.dataclass
class Cell:
    """A fake station: objects are at x = 0.3, 0.4, ...; object i fills goal `filled[i]`, if any."""

    goals: tuple[Goal, ...]
    filled: tuple[int | None, ...]
    action: PickPlaceAction = STOP
    kept: frozenset[int] = frozenset()
    last: str = "missed"
    """The outcome of the last action."""
    protrudes: float = 0.0
    """How much too high the objects are, in m."""

    @property
    def scene(self) -> Any:
        return self

    @property
    def goal_objects(self) -> tuple[int, ...]:
        return tuple(sorted({index for goal in self.goals for index in goal.objects}))

    @property
    def objects(self) -> list[PlacedObject]:
        return [PlacedObject(f"o{i}", BodyIndex(i), POINTS) for i in range(len(self.filled))]

    def placements(self, _: object) -> list[Placement]:
        errors = {"angle_error": 0.0, "height_error": self.protrudes}
        return [Placement(goal, share=float(goal is not None), **errors) for goal in self.filled]

    def object_poses(self, _: object) -> list[RigidTransform]:
        return [RigidTransform([0.3 + 0.1 * i, 0.0, 0.0]) for i in range(len(self.filled))]

    def accepted_action(self, _: object) -> PickPlaceAction:
        return self.action

    def history(self, _: object) -> tuple[Attempt, ...]:
        return (Attempt(PickPlaceAction(), "placed"), Attempt(PickPlaceAction(), self.last))

    def kept_goals(self, _: object) -> frozenset[int]:
        return self.kept


def goal(*objects: int) -> Goal:
    return Goal("g", objects, (RigidTransform([0.6, -0.2, 0.0]),), 1.0)


ONE_LEFT = Cell((goal(0), goal(1)), (0, None))
ALL_PLACED = Cell((goal(0), goal(1)), (0, 1))
FOREIGN = Cell((goal(0),), (0, None))
"""The kit is full, and the object that is left belongs in no cavity."""
KEPT = Cell((goal(0), goal(1)), (0, None), kept=frozenset({1}))


@pytest.mark.parametrize(
    ("cell", "right"),
    [
        (ONE_LEFT, {"gave up", "not sure", "not seen", "actions spent", "time", "failure"}),
        (ALL_PLACED, {"done"}),
        (dataclasses.replace(ALL_PLACED, last="placed"), {"done", "actions spent"}),
        (dataclasses.replace(ONE_LEFT, filled=(0,), last="placed"), {"done", "nothing fits"}),
        (FOREIGN, {"done", "nothing fits"}),
        (KEPT, {"done", "nothing fits"}),
        (
            dataclasses.replace(ALL_PLACED, protrudes=0.005),
            {"done", "gave up", "not sure", "not seen", "actions spent", "time", "failure"},
        ),
    ],
    ids=[
        "one left",
        "all placed",
        "all placed at last",
        "a cavity left",
        "foreign",
        "kept",
        "high",
    ],
)
def test_a_reason_is_judged_by_the_true_state(cell: Any, right: set[str]):
    reasons = ["done", "nothing fits", "gave up", "not sure", "not seen", "actions spent"]
    verdicts = {reason: is_right(reason, cell, None) for reason in [*reasons, "time", "failure"]}
    assert {reason for reason, verdict in verdicts.items() if verdict} == right


@pytest.mark.parametrize("reason", ["", "interrupted"])
def test_an_episode_that_was_cut_short_is_not_judged(reason: str):
    assert is_right(reason, ONE_LEFT, None) is None  # type: ignore[arg-type]


def test_what_is_left_over_comes_from_the_policy_or_else_from_the_true_state():
    left: Any = ONE_LEFT
    found = find_left_over(left, None)  # type: ignore[arg-type]
    assert found.source == "state"
    assert found.objects == (Position(pytest.approx(0.41), pytest.approx(0.01)),)
    assert found.cavities == (Position(pytest.approx(0.61), pytest.approx(-0.19)),)
    assert found.text == "1 object at (0.41, 0.01) and 1 cavity at (0.61, -0.19)"
    # An object that belongs to no goal is not reported.
    assert find_left_over(FOREIGN, None).text == ""  # type: ignore[arg-type]
    report = LeftOver(objects=((0.5, 0.1), (0.6, 0.1)))
    told: Any = dataclasses.replace(ONE_LEFT, action=dataclasses.replace(STOP, left_over=report))
    found = find_left_over(told, None)  # type: ignore[arg-type]
    assert (found.source, found.objects) == ("policy", (Position(0.5, 0.1), Position(0.6, 0.1)))
    assert found.text == "2 objects at (0.50, 0.10), (0.60, 0.10)"
