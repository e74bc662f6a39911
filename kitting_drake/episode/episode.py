"""One episode from its first to its last step, and its result."""

import dataclasses
import logging
import math
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

import systems
from kitting_drake.episode.action_log import ActionLog
from kitting_drake.episode.events import EpisodeObserver, ModeChange
from kitting_drake.station import Cell
from kitting_drake.tasks.task import ActionRecord, TaskConfig
from systems.pick_place_parameters import Mode
from systems.placement import ALL, Placement, strict_reward

_OWN = (Path(__file__).resolve().parent, Path(systems.__file__).resolve().parent)
"""Where the innermost Python code is when Drake fails."""
_LAST_WAIT = 2.0
"""How long the objects may take to come to rest after the last action, in s."""


@dataclasses.dataclass
class ObjectResult:
    """How one object ended. The names are keys of `results.json`."""

    name: str
    category: str
    add_s_mm: float | None
    """None, as the other errors, for an object that no goal was left for."""
    success: bool
    """By the task's own measure; for kitting the paper's, ADD-S below the threshold."""
    strict_success: bool
    """That, and at its height and heading: see `systems.placement.Placement`."""
    position_error_mm: float | None
    angle_error_deg: float | None
    """Modulo the symmetry that the object declares."""
    height_error_mm: float | None
    cause: str | None
    """Why it is no success, one of the task's `causes`; None when it is one."""


@dataclasses.dataclass
class EpisodeResult:
    """The result of an episode. The names are keys of `results.json`."""

    scenario: str
    policy: str
    seed: int
    objects: list[ObjectResult]
    """Those that a goal takes."""
    success_rate: float
    """The task's reward, 0 to 1: for kitting the share of the tools that are kitted; 0 when the
    episode failed or timed out."""
    strict_success_rate: float
    """The same, counting strict successes alone."""
    actions: int
    missed_grasps: int
    dropped_objects: int
    actions_taken: list[ActionRecord]
    """The policy's actions, and what came of each."""
    sim_seconds: float
    wall_seconds: float
    point_contact_pairs: int
    """The most pairs in point contact whenever the hand began something else."""
    moving_at_end: list[str]
    """The objects that had not come to rest when the episode ended."""
    failure: str | None
    """Why the simulation could not go on, if it could not."""
    timed_out: bool
    """Whether the time limit ended it."""
    interrupted: bool
    """Whether a person ended it."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)


def run_episode(
    cell: Cell,
    *,
    task: TaskConfig,
    scenario: str,
    policy: str,
    seed: int,
    time_limit: float,
    end_at_success: bool = False,
    realtime_rate: float = 0.0,
    observers: Sequence[EpisodeObserver] = (),
) -> EpisodeResult:
    """Runs an episode until the planner is done and the objects rest, or the time is up.

    An error of the simulation (the contact solver not converging, say) or of the policy, and
    Ctrl-C, end the episode, not the program: the result tells of it, and of what was reached.

    Args:
        cell: fresh from `build_cell`.
        task: the scenario's, which knows why objects fail.
        scenario: its name, for the result.
        policy: its name, for the result.
        seed: for the result; it has done its work in `build_cell`.
        time_limit: simulated time at which the episode ends at the latest, in s.
        end_at_success: end as soon as every goal is met, instead of asking for an action more.
        realtime_rate: 1 for real time, 0 for as fast as possible.
        observers: told of every event.
    """
    episode = Episode(
        cell,
        task=task,
        scenario=scenario,
        policy=policy,
        seed=seed,
        time_limit=time_limit,
        end_at_success=end_at_success,
        realtime_rate=realtime_rate,
        observers=observers,
    )
    episode.advance()
    return episode.result()


class Episode:
    """An episode under way: `run_episode` in parts, for who decides between them."""

    def __init__(
        self,
        cell: Cell,
        *,
        task: TaskConfig,
        scenario: str,
        policy: str,
        seed: int,
        time_limit: float,
        end_at_success: bool = False,
        realtime_rate: float = 0.0,
        observers: Sequence[EpisodeObserver] = (),
        pauses: bool = False,
    ) -> None:
        """
        Args:
            cell: as for `run_episode`, and so are the others but for the last.
            task: see there.
            scenario: see there.
            policy: see there.
            seed: see there.
            time_limit: see there.
            end_at_success: see there.
            realtime_rate: see there.
            observers: see there.
            pauses: whether `advance` returns each time the planner asks for an action.
        """
        self._cell, self._task, self._time_limit = cell, task, time_limit
        self._names = {"scenario": scenario, "policy": policy, "seed": seed}
        self._simulator = Simulator(cell.diagram)
        self._simulator.set_target_realtime_rate(realtime_rate)
        self._log = ActionLog(cell)
        self._monitor = _Monitor(
            cell,
            [self._log.observe, *observers],
            pauses=pauses,
            end_at_success=end_at_success,
        )
        self._simulator.set_monitor(self._monitor.step)
        self._failure: str | None = None
        self._wall_seconds = 0.0
        self._has_begun = False
        self.timed_out = self.interrupted = self.is_over = False

    @property
    def context(self) -> Context:
        """The context of the cell's Diagram."""
        return self._simulator.get_mutable_context()

    @property
    def failure(self) -> str | None:
        """Why the simulation could not go on, if it could not."""
        return self._failure

    def advance(self) -> None:
        """Goes on to the end of the episode, or, where it pauses, to when the planner asks.

        At a pause the action must be given before the next call.

        Raises:
            RuntimeError: the episode is over.
        """
        if self.is_over:
            raise RuntimeError("the episode is over")
        start = time.perf_counter()
        try:
            self._monitor.is_paused = False
            if not self._has_begun:
                self._has_begun = True
                self._simulator.Initialize()
            if not self._monitor.is_paused:
                self._simulator.AdvanceTo(self._time_limit)
            self.is_over = not self._monitor.is_paused
            self.timed_out = self.is_over and self._monitor.done_since is None
        except KeyboardInterrupt:
            self.is_over = self.interrupted = True
        except (Exception, SystemExit) as error:
            self._failure = " ".join(f"{type(error).__name__}: {error}".split())
            self.is_over = True
            if not _is_of_simulation(error):
                # What a policy raises may be anything, and its author wants to know where.
                seed = self._names["seed"]
                logging.getLogger(__name__).exception("the episode of seed %d failed", seed)
        self._wall_seconds += time.perf_counter() - start
        if self.is_over:
            self._monitor.tell(self.context, is_last=True)

    def result(self) -> EpisodeResult:
        """How it ended; before its end, how it stands now."""
        cell, context, records = self._cell, self.context, self._log.records
        placements = cell.placements(context)
        planner_context = cell.planner.GetMyContextFromRoot(context)
        counts = cell.planner.GetOutputPort("counts").Eval(planner_context)
        lost = self._failure is not None or self.timed_out
        at_rest = cell.at_rest(context)
        return EpisodeResult(
            **self._names,  # type: ignore[arg-type]
            objects=object_results(cell, self._task, context, placements, records),
            success_rate=0.0 if lost else cell.reward(context),
            strict_success_rate=0.0 if lost else strict_reward(cell.scene.goals, placements),
            actions=int(counts[0]),
            missed_grasps=int(counts[1]),
            dropped_objects=int(counts[2]),
            actions_taken=records,
            sim_seconds=context.get_time(),
            wall_seconds=self._wall_seconds,
            point_contact_pairs=self._monitor.point_contact_pairs,
            moving_at_end=[
                item.name for item, rests in zip(cell.objects, at_rest, strict=True) if not rests
            ],
            failure=self._failure,
            timed_out=self.timed_out,
            interrupted=self.interrupted,
        )


def _is_of_simulation(error: BaseException) -> bool:
    """Whether Drake raised an error, or one of our systems did in a sentence of its own; torch and
    people's own policies raise RuntimeErrors too."""
    frames = traceback.extract_tb(error.__traceback__)
    raised_in = Path(frames[-1].filename).resolve() if frames else None
    ours = raised_in is None or any(raised_in.is_relative_to(folder) for folder in _OWN)
    return isinstance(error, RuntimeError) and ours


def object_results(
    cell: Cell,
    task: TaskConfig,
    root_context: Context,
    placements: Sequence[Placement],
    records: Sequence[ActionRecord] = (),
) -> list[ObjectResult]:
    """How every object that a goal takes stands now, in the scene's order.

    Args:
        cell: the episode's.
        task: which knows why objects fail.
        root_context: of the cell's diagram.
        placements: of the scene's objects, in its order.
        records: the actions so far.
    """
    poses = cell.object_poses(root_context)
    results = []
    for index in cell.scene.goal_objects:
        item, placement = cell.scene.objects[index], placements[index]
        cause = None
        if not placement.success:
            cause = task.find_cause(cell.scene, index, poses, placement, records)
        results.append(_object_result(item.name, item.category, placement, cause))
    return results


def _object_result(
    name: str, category: str, placement: Placement, cause: str | None
) -> ObjectResult:
    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return ObjectResult(
        name=name,
        category=category,
        add_s_mm=finite(1e3 * placement.add_s),
        success=placement.success,
        strict_success=placement.strict_success,
        position_error_mm=finite(1e3 * placement.position_error),
        angle_error_deg=finite(math.degrees(placement.angle_error)),
        height_error_mm=finite(1e3 * placement.height_error),
        cause=cause,
    )


class _Monitor:
    """The simulator's monitor: puts objects to sleep, tells of events, knows when to halt."""

    def __init__(
        self,
        cell: Cell,
        observers: Sequence[EpisodeObserver],
        *,
        pauses: bool,
        end_at_success: bool,
    ) -> None:
        self._cell = cell
        self._pauses = pauses
        self._end_at_success = end_at_success
        self.is_paused = False
        self._observers = observers
        self._contact_results = cell.plant.get_contact_results_output_port()
        self._mode = Mode.OBSERVE
        self.point_contact_pairs = 0
        self.done_since: float | None = None

    def step(self, root_context: Context) -> EventStatus:
        """The callback that the simulator calls after every step."""
        cell = self._cell
        cell.apply_sleep(root_context)
        self.tell(root_context)
        if self._pauses or self._end_at_success:
            planner_context = cell.planner.GetMyContextFromRoot(root_context)
            asks = cell.planner.asks_now(planner_context)
            if asks and self._end_at_success and cell.reward(root_context) > ALL:
                self.done_since = root_context.get_time()
                return EventStatus.ReachedTermination(cell.diagram, "every goal is met")
            self.is_paused = asks and self._pauses
            if self.is_paused:
                return EventStatus.ReachedTermination(cell.diagram, "the planner asks")
        if self._mode != Mode.DONE:
            return EventStatus.DidNothing()
        now = root_context.get_time()
        if self.done_since is None:
            self.done_since = now
        if cell.at_rest(root_context).all() or now - self.done_since > _LAST_WAIT:
            return EventStatus.ReachedTermination(cell.diagram, "the episode is over")
        return EventStatus.DidNothing()

    def tell(self, root_context: Context, *, is_last: bool = False) -> None:
        """Tells the observers, if the mode has changed or the episode is over."""
        plant, planner = self._cell.plant, self._cell.planner
        previous, self._mode = self._mode, planner.mode(planner.GetMyContextFromRoot(root_context))
        if is_last or self._mode != previous:
            contact = self._contact_results.Eval(plant.GetMyContextFromRoot(root_context))
            pairs = contact.num_point_pair_contacts()
            self.point_contact_pairs = max(self.point_contact_pairs, pairs)
            event = ModeChange(
                self._mode if is_last else previous, self._mode, root_context, is_last
            )
            for observer in self._observers:
                observer(event)
