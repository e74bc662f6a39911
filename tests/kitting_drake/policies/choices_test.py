import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kitting_drake.policies.choices import choose_by_networks
from kitting_drake.policies.learned_policy import Decision
from systems.signals import Observation, PickPlaceAction, PlanarPose

ACT = PickPlaceAction(PlanarPose(0.4), PlanarPose(0.5))


def decision(action: PickPlaceAction, kit_seen: bool | None) -> Decision:
    even = np.full((4, 4), 1 / 16, np.float32)
    middle = np.array([2.0, 2.0])
    return Decision(
        action, even, np.ones(4, np.float32) / 4, even, middle, middle, 3.0, kit_seen=kit_seen
    )


def loaded(*made: Decision) -> Any:
    def proposals(
        observation: Observation, failed_picks: Sequence[PlanarPose]
    ) -> Iterator[tuple[PickPlaceAction, Decision]]:
        yield from ((item.action, item) for item in made)

    return SimpleNamespace(function=SimpleNamespace(proposals=proposals), path=Path("none"))


@pytest.mark.parametrize(
    ("reason", "kit_seen", "answer"),
    [
        ("", False, "no kit seen"),
        ("not seen", False, "no kit seen"),
        ("not seen", True, "not seen"),
        ("done", True, "done"),
        # A full kit shows no cavity.
        ("done", False, "done"),
        ("gave up", False, "gave up"),
    ],
)
def test_without_a_kit_the_policy_stops(reason: str, kit_seen: bool, answer: str):
    action = dataclasses.replace(ACT, stop=bool(reason), reason=reason)
    choose = choose_by_networks(loaded(decision(action, kit_seen)), 0.0)
    (choice,) = choose(Observation(), ())
    assert choice.action.stop
    assert choice.action.reason == answer


def test_without_outlines_the_networks_own_certainty_counts():
    made = decision(ACT, None)
    (choice,) = choose_by_networks(loaded(made), 0.0)(Observation(), ())
    assert (choice.action, choice.decision) == (ACT, made)
    assert choice.confidence == pytest.approx(np.prod(list(choice.parts.values())))
    (refusal,) = choose_by_networks(loaded(made), 0.99)(Observation(), ())
    assert refusal.action == PickPlaceAction(stop=True, reason="not sure")
    assert refusal.refused == ACT
