"""The stream of events of an episode, which whoever watches it is told of."""

from collections.abc import Callable
from dataclasses import dataclass

from pydrake.systems.framework import Context

from systems.pick_place_parameters import Mode


@dataclass(frozen=True)
class ModeChange:
    """The planner has gone from one mode to another; or, at its end, the episode is over.

    The plant has stepped, the planner has decided on that, and this is told one step of time later:
    nothing has moved since, but ports that depend on time, such as the noise of cameras, are
    evaluated anew.
    """

    previous: Mode
    mode: Mode
    root_context: Context
    """The context of the outermost Diagram; not to be changed, nor kept beyond the last event."""
    is_last: bool = False
    """Whether the episode is over; the modes are equal then."""

    @property
    def is_action_start(self) -> bool:
        """Whether a policy's action has just been accepted."""
        return self.previous == Mode.OBSERVE and self.mode == Mode.APPROACH

    @property
    def is_stop(self) -> bool:
        """Whether the planner is done: the policy said stop, or the actions are spent."""
        return self.previous == Mode.OBSERVE and self.mode == Mode.DONE


EpisodeObserver = Callable[[ModeChange], None]
"""Told of every event, in order."""
