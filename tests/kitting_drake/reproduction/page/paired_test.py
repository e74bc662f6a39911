import numpy as np
import pytest

from kitting_drake.reproduction.page.paired import (
    OWN,
    STRICT,
    mean_paired_difference,
    over_tools,
    paired_difference,
    points_text,
)


def run(rates: dict[int, float]) -> dict:
    return {
        "outcomes": [
            {"seed": seed, "strict_success_rate": rate, "success_rate": 1.0, "objects": {}}
            for seed, rate in rates.items()
        ]
    }


def test_a_difference_uses_the_seeds_that_both_ran():
    found = paired_difference(run({1: 1.0, 2: 0.5, 3: 1.0}), run({2: 0.25, 3: 1.0, 4: 0.0}), STRICT)
    assert found.value == pytest.approx(0.125)
    assert 0 <= found.low <= found.value <= found.high <= 0.25
    assert paired_difference(run({1: 1.0}), run({2: 1.0}), STRICT) is None


def test_episodes_are_resampled_jointly_over_runs():
    zeros = run(dict.fromkeys(range(50), 0.0))
    halves = ({i: float(i % 2 == k) for i in range(50)} for k in (0, 1))
    pairs = [(run(rates), zeros) for rates in halves]
    found = mean_paired_difference(pairs, STRICT)
    # In every episode one pair gains 1 and the other 0, so their mean does not vary.
    assert (found.low, found.value, found.high) == (0.5, 0.5, 0.5)
    assert paired_difference(*pairs[0], STRICT).low < 0.45
    assert mean_paired_difference([*pairs, (run({99: 1.0}), zeros)], STRICT) is None


def test_hard_scenes_do_not_widen_the_interval_of_the_difference():
    rng = np.random.default_rng(1)
    hard = rng.uniform(0, 0.8, 200)
    found = paired_difference(
        run({i: hard[i] + 0.1 for i in range(200)}), run(dict(enumerate(hard))), STRICT
    )
    assert (found.low, found.high) == pytest.approx((0.1, 0.1), abs=1e-9)


def test_the_interval_has_its_nominal_coverage():
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(100):
        first, second = (dict(enumerate(rng.binomial(4, p, 60) / 4)) for p in (0.9, 0.8))
        found = paired_difference(run(first), run(second), STRICT)
        held += found.low <= 0.1 <= found.high
    assert held >= 88


def test_equal_runs_are_reported_as_such():
    same = run(dict.fromkeys(range(100), 1.0))
    found = paired_difference(same, same, OWN)
    assert (found.low, found.value, found.high) == (0.0, 0.0, 0.0)
    assert points_text(found) == "+0.0 (none differs)"
    other = paired_difference(run({1: 1.0, 2: 0.5}), run({1: 0.5, 2: 1.0}), STRICT)
    assert points_text(other) == "+0.0 (-50.0 to +50.0)"


def outcomes(by_tool: dict[str, list[int]]) -> list[dict]:
    count = max(map(len, by_tool.values()))
    return [
        {"objects": {name: found[i] for name, found in by_tool.items() if i < len(found)}}
        for i in range(count)
    ]


def test_the_interval_over_tools_is_wide_if_tools_differ():
    good = {f"tool{i}": [2] * 50 for i in range(5)}
    bad = {f"bad{i}": [1, 0] * 25 for i in range(3)}
    found = over_tools(outcomes({**good, **bad}), STRICT)
    assert found.value == pytest.approx(250 / 400)
    assert found.low < 0.4 and found.high > 0.85
    own = over_tools(outcomes({**good, **bad}), OWN)
    assert own.value == pytest.approx(325 / 400)


def test_without_enough_failing_tools_there_is_no_interval():
    good = {f"tool{i}": [2] * 50 for i in range(18)}
    one = {"bad": [1, 0] * 25}
    for by_tool in (good, good | one, {**one, "worse": [0] * 50}, {}):
        assert over_tools(outcomes(by_tool) if by_tool else [{"objects": {}}], STRICT) is None
