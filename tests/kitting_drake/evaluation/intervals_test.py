import itertools

import pytest

from kitting_drake.evaluation.intervals import mean_interval, proportion_interval


def test_proportion_interval():
    # Wilson's interval for 8 of 10.
    assert proportion_interval(8, 10) == pytest.approx([0.4902, 0.9433], abs=1e-4)
    low, high = proportion_interval(200, 200)
    assert high == pytest.approx(1.0)
    assert low == pytest.approx(200 / (200 + 1.959964**2))


def test_mean_interval_of_partial_rewards():
    # Student's t(0.975) with 3 degrees of freedom is 3.1824; the standard deviation is 0.0816497.
    low, high = mean_interval([0.4, 0.5, 0.5, 0.6])
    assert (low + high) / 2 == pytest.approx(0.5)
    assert (high - low) / 2 == pytest.approx(3.1824 * 0.0816497 / 2, rel=1e-4)
    # The interval stays between 0 and 1.
    assert mean_interval([0.2, 1.0])[1] == 1.0


@pytest.mark.parametrize("score", [0.0, 0.43, 1.0])
@pytest.mark.parametrize("count", [1, 10])
def test_mean_interval_of_equal_scores_has_a_width(score: float, count: int):
    low, high = mean_interval([score] * count)
    assert low <= score <= high
    assert high - low > 1 / (count + 4)


def test_mean_interval_of_zeros_and_ones_is_wilsons():
    assert mean_interval([1.0] * 13 + [0.0] * 7) == proportion_interval(13, 20)


def test_another_failure_never_raises_the_lower_end():
    ends = [mean_interval([1.0] * (100 - failures) + [2 / 3] * failures) for failures in range(30)]
    lows = [low for low, _ in ends]
    assert lows[0] == pytest.approx(proportion_interval(100, 100)[0])
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(lows[:10]))
