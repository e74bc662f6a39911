"""Runs one episode, records its actions and scores it."""

from kitting_drake.episode.episode import Episode, EpisodeResult, run_episode
from kitting_drake.episode.events import EpisodeObserver, ModeChange

__all__ = ["Episode", "EpisodeObserver", "EpisodeResult", "ModeChange", "run_episode"]
