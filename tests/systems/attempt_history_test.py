import numpy as np

from systems.attempt_history import MOST_ATTEMPTS, AttemptHistory, LeftOverVector
from systems.signals import LeftOver, PickPlaceAction, PlanarPose


def action(number: int) -> PickPlaceAction:
    return PickPlaceAction(
        PlanarPose(number, 0.1, 0.2),
        PlanarPose(0.5, -0.1, 1.0),
        press=True,
        middle=(0.3, number) if number % 3 else None,
        spread=(0.01, -0.02, number) if number % 3 else None,
    )


def test_attempts_come_back_in_order_and_the_oldest_are_forgotten():
    history = AttemptHistory(np.full(AttemptHistory.size, np.nan))
    assert history.attempts() == history.failed_picks() == ()
    for number in range(MOST_ATTEMPTS + 3):
        floor = -float(number) if number % 2 else None
        outcome = "placed" if number % 2 else "missed"
        history.append(action(number), outcome, float(number), floor=floor)
    found = history.attempts()
    assert [item.action for item in found] == [action(3 + n) for n in range(MOST_ATTEMPTS)]
    assert [item.peak_force for item in found] == [3.0 + n for n in range(MOST_ATTEMPTS)]
    assert [item.floor for item in found] == [
        -3.0 - n if (3 + n) % 2 else None for n in range(MOST_ATTEMPTS)
    ]
    assert [pick.x for pick in history.failed_picks()] == list(range(36, 67, 2))
    history.amend("stopped", 40.0)
    last = history.attempts()[-1]
    assert (last.outcome, last.peak_force) == ("stopped", 40.0)


def test_a_report_comes_back():
    vector = np.zeros(LeftOverVector.size)
    kept = LeftOverVector(vector)
    assert kept.read() is None
    for report in (LeftOver(((0.4, 0.1), (0.5, 0.2)), ((0.6, -0.3),)), LeftOver(), None):
        kept.write(report)
        assert LeftOverVector(vector.copy()).read() == report


def test_a_felt_centre_of_mass_comes_back_and_tells_its_object_by_its_place():
    history = AttemptHistory(np.full(AttemptHistory.size, np.nan))
    history.append(action(0), "placed", 1.0, top=0.04)
    history.append(action(0), "set down", 1.0, (0.4, 0.1))
    assert [item.top for item in history.attempts()] == [0.04, None]
    assert [item.balance for item in history.attempts()] == [None, (0.4, 0.1)]
    assert history.set_downs(PlanarPose(0.42, 0.1)) == 1
    assert history.set_downs(PlanarPose(0.5, 0.1)) == 0
