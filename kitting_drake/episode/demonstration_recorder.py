"""Records an expert's decisions as a demonstration."""

from __future__ import annotations

from collections import Counter

from kitting_drake.common.provenance import commit
from kitting_drake.episode.episode import EpisodeResult
from kitting_drake.episode.events import ModeChange
from kitting_drake.policies.data.demonstrations import Demonstration, Rejection
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation
from kitting_drake.station import KittingStation
from systems.signals import Observation, PickPlaceAction

LEAST_SCORE = 0.99
"""Episodes with a lower success rate are rejected as demonstrations."""


class DemonstrationRecorder:
    """Records the observations and actions of an episode, as an `EpisodeObserver`."""

    def __init__(self, station: KittingStation, *, later_picks_possible: bool = False) -> None:
        """
        Args:
            station: a station with cameras and the oracle.
            later_picks_possible: see `Learning`. If set, episodes with two actions on one object
                are rejected: the first action moves the object, so its later pick would be a wrong
                label for earlier observations.
        """
        self._station = station
        self._later_picks_possible = later_picks_possible
        self._actions: list[tuple[Observation, PickPlaceAction]] = []
        self._final: FinalObservation | None = None

    def observe(self, event: ModeChange) -> None:
        """Records observation and action when an action begins, and the observation when the expert
        stops."""
        if event.is_last or not (event.is_action_start or event.is_stop):
            return
        observation = self._station.observation(event.root_context)
        if event.is_stop:
            self._final = FinalObservation.of(observation)
        else:
            action = self._station.proposed_action(event.root_context)
            self._actions.append((observation, action))

    def demonstration(self, result: EpisodeResult) -> Demonstration | Rejection:
        """Makes the demonstration of a finished episode, without its failed actions. Returns a
        `Rejection` if the episode is unsuitable for learning."""
        if result.failure or result.success_rate < LEAST_SCORE:
            reason = result.failure or f"the reward was {result.success_rate:.0%}"
            return Rejection(result.seed, result.success_rate, reason)
        taken = Counter(item.object for item in result.actions_taken)
        again = next((name for name, times in taken.items() if times > 1), None)
        if self._later_picks_possible and again is not None:
            return Rejection(result.seed, result.success_rate, f"{again} needed a second action")
        steps = tuple(
            DemonstrationStep.of(observation, action, name=item.object, category=item.category)
            for (observation, action), item in zip(self._actions, result.actions_taken, strict=True)
            if item.outcome == "placed"
        )
        if not steps:
            return Rejection(result.seed, result.success_rate, "no action was needed")
        # All goals are met, so the final observation shows a finished task.
        return Demonstration(result.seed, result.success_rate, steps, self._final, commit())
