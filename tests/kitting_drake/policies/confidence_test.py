"""The confidence of decisions: how it is fitted, and the evidence from which it is computed."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kitting_drake.policies.confidence import FILE, ranked, read_reliability
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from kitting_drake.reproduction.benchmarks.reliability import (
    LEAST_CONFIDENCE,
    Judged,
    fit,
    summarize,
)
from systems.pick_place_parameters import PickPlaceParameters
from tests.kitting_drake.policies.matching.regions.visibility_test import kit_and_bar


def drawn(seed: int, count: int = 2000) -> list[Judged]:
    """Random decisions; the chance of success is a logistic function of two features, a and b."""
    random = np.random.default_rng(seed)
    facts = random.normal(size=(count, 2))
    probability = 1 / (1 + np.exp(-(1.0 + 3 * facts[:, 0] - 2 * facts[:, 1])))
    right = random.random(count) < probability
    return [
        Judged("networks", number, "right" if good else "place", {"a": a, "b": b}, 0)
        for number, (good, (a, b)) in enumerate(zip(right, facts.tolist(), strict=True))
    ]


def test_the_fit_finds_the_law_and_is_calibrated():
    found = fit(drawn(0, 20_000))
    assert found.weights["a"] == pytest.approx(3, rel=0.15)
    assert found.weights["b"] == pytest.approx(-2, rel=0.15)
    others = drawn(1)
    confidences = [found.confidence(item.evidence) for item in others]
    summary = summarize(others, confidences, 0.9)
    assert summary.calibration_error < 0.03
    assert summary.wrong_answers < 0.05
    assert sum(count for *_, count in summary.bins) == summary.decisions == 2000
    # The calibration error reveals a confidence that is always high.
    assert summarize(others, [0.98] * len(others), 0.9).calibration_error > 0.2


@pytest.mark.parametrize(
    ("confidences", "least", "asked"),
    [
        ([0.99, 0.999], 0.9, 1),
        ([0.4, 0.985, 0.99], 0.9, 2),
        ([0.92, 0.97, 0.4, 0.99], 0.9, 3),
        ([0.985, 0.4, 0.995], 0.99, 3),
        ([0.3], 0.9, 1),
    ],
)
def test_the_surest_proposal_comes_first(confidences: list[float], least: float, asked: int):
    """A proposal takes time, so none is made after one that is clearly sure."""
    made = []

    def propose() -> Iterator[float]:
        for confidence in confidences:
            made.append(confidence)
            yield confidence

    found = ranked(propose(), lambda confidence: confidence, least)
    assert len(made) == asked
    assert found == sorted(made, reverse=True)


def test_the_proposal_that_is_chosen_counts():
    proposals = [
        Judged("networks", 0, "place", {}, 0),
        Judged("networks", 0, "right", {}, 0),
        Judged("networks", 1, "right", {}, 0),
        Judged("networks", 1, "stop", {}, 0, "done"),
        Judged("networks", 2, "stop", {}, 0, "done"),
    ]
    summary = summarize(proposals, [0.5, 0.95, 0.8, 0.0, 0.0], 0.9)
    assert (summary.decisions, summary.right) == (2, 1.0)
    assert (summary.wrong_answers, summary.refused) == (0.0, 0.5)


@pytest.mark.parametrize("policy", ["networks", "shape_matching"])
def test_the_shipped_regressions(policy: str):
    found = read_reliability(policy)
    assert found.threshold == LEAST_CONFIDENCE
    assert found.weights["fit"] < 0


def test_a_regression_may_be_older_than_a_fact(tmp_path: Path):
    record = json.loads(FILE.read_text())
    del record["networks"]["weights"]["height_off"]
    (tmp_path / "own.confidence.json").write_text(json.dumps(record))
    old = read_reliability("networks", tmp_path / "own.safetensors")
    facts = dict.fromkeys(read_reliability("networks").weights.keys() - {""}, 0.5)
    assert old.confidence(facts) == old.confidence(facts | {"height_off": 8.0})
    new = read_reliability("networks")
    assert new.confidence(facts) > new.confidence(facts | {"height_off": 8.0})


def test_a_poor_fit_is_less_likely_to_succeed():
    policy, reliability = (
        ShapeMatchingPolicy(PickPlaceParameters()),
        read_reliability("shape_matching"),
    )
    good = kit_and_bar(None)
    image = good.image.copy()
    image[3, 78:88, 220:262] = 0.015  # The object is shorter and wider than its recess.
    poor = policy.decide(dataclasses.replace(good, image=image, edge_height=None)).geometry
    best = policy.decide(good).geometry
    assert best is not None and reliability.confidence(best) > 0.9
    assert poor is None or reliability.confidence(poor) < reliability.confidence(best)
