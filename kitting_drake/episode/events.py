"""The events of an episode."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pydrake.systems.framework import Context

from systems.pick_place_parameters import Mode


@dataclass(frozen=True)
class ModeChange:
    """The planner changed its mode or, as the last event, the episode ended.

    Observers are called one time step after the change. The bodies have not moved since the
    planner's update, but ports that depend on time, such as those with camera noise, have new
    values.
    """

    previous: Mode
    mode: Mode
    root_context: Context
    """The context of the outermost Diagram. Do not modify it or keep it beyond the last event."""
    is_last: bool = False
    """Whether the episode ended; `previous` and `mode` are then equal."""

    @property
    def is_action_start(self) -> bool:
        """Whether the planner has just accepted an action."""
        return self.previous == Mode.OBSERVE and self.mode == Mode.APPROACH

    @property
    def is_stop(self) -> bool:
        """Whether the planner has stopped, because the policy returned `stop` or no actions are
        left."""
        return self.previous == Mode.OBSERVE and self.mode == Mode.DONE


EpisodeObserver = Callable[[ModeChange], None]
"""A function that is called with every event, in order."""


class Sampler(Protocol):
    """An object whose `sample` is called after every step, in order."""

    def sample(self, root_context: Context) -> None:
        """Reads values from the context of the outermost Diagram, without changing it."""
