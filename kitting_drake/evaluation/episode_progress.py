"""A progress bar of an episode."""

from pydrake.systems.framework import Context
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kitting_drake.episode import ModeChange
from kitting_drake.station import KittingStation
from systems.pick_place_parameters import Mode


class EpisodeProgress:
    """A progress bar with a step for each action. Pass its method `observe` as an
    `EpisodeObserver`."""

    def __init__(self, console: Console, station: KittingStation) -> None:
        self._station = station
        self._progress = Progress(
            TextColumn("{task.description:9}"),
            BarColumn(),
            TextColumn("{task.fields[seconds]:.1f} s simulated"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=len(station.scene.goals), seconds=0.0)
        self.last_context: Context | None = None

    def __enter__(self) -> "EpisodeProgress":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def observe(self, event: ModeChange) -> None:
        """Shows the planner's present mode."""
        self.last_context = event.root_context
        actions, *_ = self._station.counts(event.root_context)
        finished = actions - (event.mode not in (Mode.OBSERVE, Mode.DONE))
        self._progress.update(
            self._task,
            completed=min(finished, len(self._station.scene.goals)),
            description=event.mode.name.lower(),
            seconds=event.root_context.get_time(),
        )
