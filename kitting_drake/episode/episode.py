"""One episode from its first to its last step, and what is to be said of it afterwards."""

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from kitting_drake.cell.cell import Cell
from kitting_drake.episode.action_log import ActionRecord, ActionRecorder, find_cause, object_poses
from systems.pick_place_planner import Mode

_LAST_WAIT = 2.0
"""How long the tools may take to come to rest after the last action, in s."""


@dataclasses.dataclass
class ObjectResult:
    """How one object ended. The names are keys of `results.json`."""

    name: str
    category: str
    add_s_mm: float
    success: bool
    """By the paper's measure alone: ADD-S below the threshold."""
    position_error_mm: float
    angle_error_deg: float
    height_error_mm: float
    cause: str | None
    """Why it is no success; None when it is one."""


@dataclasses.dataclass
class EpisodeResult:
    """What came of an episode. The names are keys of `results.json`."""

    scenario: str
    policy: str
    seed: int
    objects: list[ObjectResult]
    success_rate: float
    """Share of the objects placed successfully; 0 when the episode failed."""
    actions: int
    missed_grasps: int
    dropped_objects: int
    actions_taken: list[ActionRecord]
    """What the policy answered each time, and what came of it."""
    sim_seconds: float
    wall_seconds: float
    point_contact_pairs: int
    """The most pairs in point contact at any step."""
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
    scenario: str,
    policy: str,
    seed: int,
    time_limit: float,
    realtime_rate: float = 0.0,
    watch: Callable[[Context, Mode], None] | None = None,
) -> EpisodeResult:
    """Runs an episode until the planner is done and the tools rest, or the time is up.

    An error of the simulation (the contact solver not converging, say) or of the policy, and
    Ctrl-C, end the episode, not the program: the result tells of it, and of what was reached.

    Args:
        cell: fresh from `build_cell`.
        scenario: names for the result.
        policy: likewise.
        seed: likewise; it has done its work in `build_cell`.
        time_limit: simulated time at which the episode ends at the latest, in s.
        realtime_rate: 1 for real time, 0 for as fast as possible.
        watch: called after every step with the root context and the planner's mode.
    """
    simulator = Simulator(cell.diagram)
    simulator.set_target_realtime_rate(realtime_rate)
    monitor = _Monitor(cell, watch)
    simulator.set_monitor(monitor.look)
    failure, timed_out, interrupted = None, False, False
    start = time.perf_counter()
    try:
        simulator.Initialize()
        simulator.AdvanceTo(time_limit)
        timed_out = monitor.done_since is None
    except KeyboardInterrupt:
        interrupted = True
    except (Exception, SystemExit) as error:
        # Drake's own errors are RuntimeErrors; what a policy raises may be anything, and its author
        # wants to know where.
        failure = " ".join(f"{type(error).__name__}: {error}".split())
        if not isinstance(error, RuntimeError):
            logging.getLogger(__name__).exception("the episode of seed %d failed", seed)
    wall_seconds = time.perf_counter() - start
    context = simulator.get_context()
    objects = score(cell, context, monitor.recorder.records)
    succeeded = sum(item.success for item in objects) / len(objects)
    counts = cell.planner.GetOutputPort("counts").Eval(cell.planner.GetMyContextFromRoot(context))
    return EpisodeResult(
        scenario=scenario,
        policy=policy,
        seed=seed,
        objects=objects,
        success_rate=0.0 if failure else succeeded,
        actions=int(counts[0]),
        missed_grasps=int(counts[1]),
        dropped_objects=int(counts[2]),
        actions_taken=monitor.recorder.records,
        sim_seconds=context.get_time(),
        wall_seconds=wall_seconds,
        point_contact_pairs=monitor.point_contact_pairs,
        failure=failure,
        timed_out=timed_out,
        interrupted=interrupted,
    )


def score(
    cell: Cell, root_context: Context, actions_taken: Sequence[ActionRecord] = ()
) -> list[ObjectResult]:
    """How every object stands now, in the order in which an oracle takes them.

    Args:
        cell: the episode's.
        root_context: of the cell's diagram.
        actions_taken: what was done so far, to tell why objects are not where they belong.
    """
    context = cell.monitor.GetMyContextFromRoot(root_context)
    columns = [
        cell.monitor.GetOutputPort(name).Eval(context).tolist()
        for name in ("add_s", "position_error", "angle_error", "height_error")
    ]
    poses = object_poses(cell, root_context)
    results = []
    for index, (tool, add_s, position, angle, height) in enumerate(
        zip(cell.scene.tools, *columns, strict=True)
    ):
        success = add_s < cell.scene.success_threshold
        results.append(
            ObjectResult(
                name=tool.name,
                category=tool.category,
                add_s_mm=1e3 * add_s,
                success=success,
                position_error_mm=1e3 * position,
                angle_error_deg=math.degrees(angle),
                height_error_mm=1e3 * height,
                cause=None if success else find_cause(cell, index, poses[index], actions_taken),
            )
        )
    return results


class _Monitor:
    """The simulator's monitor: puts tools to sleep, takes notes, knows the end."""

    def __init__(self, cell: Cell, watch: Callable[[Context, Mode], None] | None) -> None:
        self._cell = cell
        self._watch = watch
        self._contact_results = cell.plant.get_contact_results_output_port()
        self.recorder = ActionRecorder(cell)
        self.point_contact_pairs = 0
        self.done_since: float | None = None

    def look(self, root_context: Context) -> EventStatus:
        cell = self._cell
        results = self._contact_results.Eval(cell.plant.GetMyContextFromRoot(root_context))
        self.point_contact_pairs = max(self.point_contact_pairs, results.num_point_pair_contacts())
        cell.apply_sleep(root_context)
        mode = cell.planner.mode(cell.planner.GetMyContextFromRoot(root_context))
        self.recorder.look(root_context, mode)
        if self._watch is not None:
            self._watch(root_context, mode)
        if mode != Mode.DONE:
            return EventStatus.DidNothing()
        now = root_context.get_time()
        if self.done_since is None:
            self.done_since = now
        at_rest = cell.rest_detector.at_rest(cell.rest_detector.GetMyContextFromRoot(root_context))
        if at_rest.all() or now - self.done_since > _LAST_WAIT:
            return EventStatus.ReachedTermination(cell.diagram, "the episode is over")
        return EventStatus.DidNothing()
