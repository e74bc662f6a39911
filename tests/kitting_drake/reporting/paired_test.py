import numpy as np
import pytest

from kitting_drake.reporting.paired import OWN, STRICT, over_tools, paired_difference


def run(rates: dict[int, float]) -> dict:
    return {
        "outcomes": [
            {"seed": seed, "strict_success_rate": rate, "success_rate": 1.0, "objects": {}}
            for seed, rate in rates.items()
        ]
    }


def test_a_difference_is_of_the_seeds_that_both_ran():
    found = paired_difference(run({1: 1.0, 2: 0.5, 3: 1.0}), run({2: 0.25, 3: 1.0, 4: 0.0}), STRICT)
    assert found.value == pytest.approx(0.125)
    assert 0 <= found.low <= found.value <= found.high <= 0.25
    assert paired_difference(run({1: 1.0}), run({2: 1.0}), STRICT) is None


def test_what_is_hard_for_both_does_not_widen_the_interval_of_the_difference():
    rng = np.random.default_rng(1)
    hard = rng.uniform(0, 0.8, 200)
    found = paired_difference(
        run({i: hard[i] + 0.1 for i in range(200)}), run(dict(enumerate(hard))), STRICT
    )
    assert (found.low, found.high) == pytest.approx((0.1, 0.1), abs=1e-9)


def test_the_interval_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(100):
        first, second = (dict(enumerate(rng.binomial(4, p, 60) / 4)) for p in (0.9, 0.8))
        found = paired_difference(run(first), run(second), STRICT)
        held += found.low <= 0.1 <= found.high
    assert held >= 88


def test_runs_that_never_differ_may_still_differ_a_little():
    same = run(dict.fromkeys(range(100), 1.0))
    found = paired_difference(same, same, OWN)
    assert (found.value, found.low) == (0.0, -found.high)
    assert 0.01 < found.high < 0.05


def outcomes(by_tool: dict[str, list[int]]) -> list[dict]:
    count = max(map(len, by_tool.values()))
    return [
        {"objects": {name: found[i] for name, found in by_tool.items() if i < len(found)}}
        for i in range(count)
    ]


def test_one_bad_tool_of_a_few_says_little_of_others():
    good = {f"tool{i}": [2] * 50 for i in range(5)}
    found = over_tools(outcomes({**good, "bad": [1, 0] * 25}), STRICT)
    assert found.value == pytest.approx(250 / 300)
    assert found.low < 0.7
    own = over_tools(outcomes({**good, "bad": [1, 0] * 25}), OWN)
    assert own.value == pytest.approx(275 / 300)
    perfect = over_tools(outcomes(good), STRICT)
    assert perfect.value == perfect.high == 1.0
    assert perfect.low < 0.7
    assert over_tools([{"objects": {}}], STRICT) is None
