"""Runs one episode and computes its result."""

import dataclasses
import logging
import math
import time
from collections.abc import Sequence
from typing import Any

from pydrake.systems.framework import Context, Diagram, EventStatus

from kitting_drake.episode.action_log import ActionLog
from kitting_drake.episode.arm_use import ArmUse, ArmUseMeter
from kitting_drake.episode.ending import Remainder, find_left_over, is_right
from kitting_drake.episode.events import EpisodeObserver, ModeChange, Sampler
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station import KittingStation
from kitting_drake.tasks.task import ActionRecord
from systems.pick_place_parameters import Mode
from systems.pick_place_policy import PolicyError
from systems.placement import ALL, Placement, strict_reward

_LAST_WAIT = 2.0
"""Time limit for objects to come to rest after the last action, in s."""


@dataclasses.dataclass
class ObjectResult:
    """The final state of one object. The field names are keys of `results.json`."""

    name: str
    category: str
    add_s_mm: float | None
    """ADD-S between the object's pose and its goal, in mm. This and the other errors are None if no
    goal was left for the object."""
    success: bool
    """Whether the object fills its goal by the task's success predicate. In kitting this is the
    paper's predicate: ADD-S below a threshold."""
    strict_success: bool
    """Whether the object fills its goal and also has the right height and heading; see
    `systems.placement.Placement.strict_success`."""
    position_error_mm: float | None
    angle_error_deg: float | None
    """Heading error, modulo the object's declared symmetry, in degrees."""
    height_error_mm: float | None
    cause: str | None
    """Why the object failed, one of the task's `causes`; None for a success."""
    measures: dict[str, bool] = dataclasses.field(default_factory=dict)
    """Whether the object is a success, for each name in `Scene.measures`. The key `strict` stands
    for `strict_success`. Empty if the scene has no such measures."""


@dataclasses.dataclass
class EpisodeResult:
    """The result of an episode. The field names are keys of `results.json`."""

    scenario: str
    policy: str
    seed: int
    objects: list[ObjectResult]
    """The results of the objects that can fill a goal."""
    success_rate: float
    """The task's reward, from 0 to 1 (in kitting, the share of kitted tools); 0 if the episode
    failed or timed out."""
    strict_success_rate: float
    """The task's reward if only strict successes count, from 0 to 1."""
    actions: int
    missed_grasps: int
    dropped_objects: int
    stopped_actions: int
    """Number of actions that ended because a contact force exceeded `planner.force_limit`."""
    actions_taken: list[ActionRecord]
    """The policy's actions and their outcomes."""
    sim_seconds: float
    wall_seconds: float
    point_contact_pairs: int
    """The largest number of point contacts (in place of hydroelastic ones) at any mode change."""
    moving_at_end: list[str]
    """The objects that had not come to rest at the end."""
    failure: str | None
    """The error that ended the episode, if any."""
    timed_out: bool
    """Whether the time limit ended the episode."""
    interrupted: bool
    """Whether Ctrl-C ended the episode."""
    stop_reason: str
    """Why no more actions followed: a key of `STOP_REASONS`, `time`, `failure` or `interrupted`;
    empty before the end."""
    stop_reason_right: bool | None = None
    """Whether the true state confirms the reason (see `ending.is_right`); None if it is not
    judged."""
    left_over: Remainder = dataclasses.field(default_factory=Remainder)
    """Objects that are not placed and cavities that are not filled."""
    arm: ArmUse | None = None
    """How much of its limits the arm used, and what its links touched; None for a floating hand."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the result as plain values for JSON."""
        return dataclasses.asdict(self)


def run_episode(
    diagram: Diagram,
    station: KittingStation,
    *,
    scenario: str,
    policy: str,
    realtime_rate: float = 0.0,
    observers: Sequence[EpisodeObserver] = (),
    log: Sampler | None = None,
) -> EpisodeResult:
    """Runs an episode until the planner is done and the objects rest, or until the time limit.

    After Ctrl-C, or an error of the policy or the simulation, only the episode ends, not the
    program. The result then has `failure` or `interrupted` set.

    Args:
        diagram: the outermost Diagram, with the station and a connected policy.
        station: a new station from `build_station`. Its scenario sets the time limit.
        scenario: name of the scenario, for the result.
        policy: name of the policy, for the result.
        realtime_rate: 1 for real time, 0 for as fast as possible.
        observers: functions that are called with every event.
        log: if given, its `sample` is called after every step.
    """
    episode = Episode(
        diagram,
        station,
        scenario=scenario,
        policy=policy,
        realtime_rate=realtime_rate,
        observers=observers,
        log=log,
    )
    episode.advance()
    return episode.result()


class Episode:
    """An episode that can be run in parts, for callers that choose each action."""

    def __init__(
        self,
        diagram: Diagram,
        station: KittingStation,
        *,
        scenario: str,
        policy: str,
        realtime_rate: float = 0.0,
        observers: Sequence[EpisodeObserver] = (),
        log: Sampler | None = None,
        pauses: bool = False,
    ) -> None:
        """
        Args:
            diagram: the outermost Diagram; with `pauses` it may be the station alone.
            pauses: whether `advance` returns each time the planner needs an action.

        The other arguments are those of `run_episode`.
        """
        self._station = station
        self._names = {"scenario": scenario, "policy": policy, "seed": station.seed}
        self._log = ActionLog(station)
        told = [self._log.observe, *observers]
        has_arm = isinstance(station.scenario.robot, FrankaArm)
        self._arm = ArmUseMeter(station) if has_arm else None
        samplers = [it for it in (self._arm, log) if it is not None]
        self._monitor = _Monitor(station, told, samplers, pauses=pauses)
        self._simulator = station.make_simulator(diagram, monitor=self._monitor.step)
        self._simulator.set_target_realtime_rate(realtime_rate)
        self._failure: str | None = None
        self._wall_seconds = 0.0
        self._has_begun = False
        self.timed_out = self.interrupted = self.is_over = False

    @property
    def context(self) -> Context:
        """The context of the outermost Diagram."""
        return self._simulator.get_mutable_context()

    @property
    def failure(self) -> str | None:
        """The error that ended the episode, if any."""
        return self._failure

    def advance(self) -> None:
        """Advances to the end of the episode or, with `pauses`, until the planner needs an action.

        After a pause, set the action before the next call.

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
                self._simulator.AdvanceTo(self._station.scenario.time_limit)
            self.is_over = not self._monitor.is_paused
            self.timed_out = self.is_over and self._monitor.done_since is None
        except KeyboardInterrupt:
            self.is_over = self.interrupted = True
        except (Exception, SystemExit) as error:
            reason = error.__cause__ or error if isinstance(error, PolicyError) else error
            self._failure = " ".join(f"{type(reason).__name__}: {reason}".split())
            self.is_over = True
            if reason is not error or not isinstance(error, RuntimeError):
                # For Drake's RuntimeErrors the text suffices. A policy may raise any exception, so
                # log the traceback for its author.
                seed = self._names["seed"]
                logging.getLogger(__name__).exception("the episode of seed %d failed", seed)
        self._wall_seconds += time.perf_counter() - start
        if self.is_over:
            self._monitor.tell(self.context, is_last=True)

    def result(self) -> EpisodeResult:
        """The result of the episode; before the end it is preliminary."""
        station, context, records = self._station, self.context, self._log.records
        placements, scene = station.placements(context), station.scene
        counts = station.counts(context)
        lost = self._failure is not None or self.timed_out
        at_rest = station.at_rest(context)
        reason = self._stop_reason()
        return EpisodeResult(
            **self._names,  # type: ignore[arg-type]
            objects=object_results(station, context, placements, records),
            success_rate=0.0 if lost else station.reward(context),
            strict_success_rate=0.0 if lost else strict_reward(scene.goals, placements),
            actions=counts[0],
            missed_grasps=counts[1],
            dropped_objects=counts[2],
            stopped_actions=counts[3],
            actions_taken=records,
            sim_seconds=context.get_time(),
            wall_seconds=self._wall_seconds,
            point_contact_pairs=self._monitor.point_contact_pairs,
            moving_at_end=[
                item.name for item, rests in zip(station.objects, at_rest, strict=True) if not rests
            ],
            failure=self._failure,
            timed_out=self.timed_out,
            interrupted=self.interrupted,
            stop_reason=reason,
            stop_reason_right=is_right(reason, station, context),
            left_over=find_left_over(station, context),
            arm=None if self._arm is None else self._arm.result(),
        )

    def _stop_reason(self) -> str:
        if self._failure is not None or self.timed_out or self.interrupted:
            ended = {"failure": self._failure is not None, "time": self.timed_out}
            return next((word for word, true in ended.items() if true), "interrupted")
        action = self._station.accepted_action(self.context)
        if action.stop:
            return action.reason
        return "done" if self.is_over else ""


def object_results(
    station: KittingStation,
    root_context: Context,
    placements: Sequence[Placement],
    records: Sequence[ActionRecord] = (),
) -> list[ObjectResult]:
    """The results of all objects that can fill a goal, in the scene's order.

    Args:
        station: the station of the episode.
        root_context: the root context of the outermost Diagram.
        placements: the placements of the scene's objects, in order.
        records: the actions so far.
    """
    scene, task = station.scene, station.scenario.task
    poses = station.object_poses(root_context)
    results = []
    for index in scene.goal_objects:
        item, placement = scene.objects[index], placements[index]
        cause = None
        if not placement.success:
            cause = task.find_cause(scene, index, poses, placement, records)
        measures = {
            name: measure.share(placement, poses[index]) > ALL
            for name, measure in scene.measures.items()
        }
        if measures:
            measures["strict"] = placement.strict_success
        results.append(_object_result(item.name, item.category, placement, cause, measures))
    return results


def _object_result(
    name: str,
    category: str,
    placement: Placement,
    cause: str | None,
    measures: dict[str, bool],
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
        measures=measures,
    )


class _Monitor:
    """The simulator's monitor: notifies observers and decides when to stop."""

    def __init__(
        self,
        station: KittingStation,
        observers: Sequence[EpisodeObserver],
        samplers: Sequence[Sampler],
        *,
        pauses: bool,
    ) -> None:
        self._station = station
        self._samplers = samplers
        self._pauses = pauses
        self._end_at_success = station.scenario.end_at_success and not pauses
        self.is_paused = False
        self._observers = observers
        self._mode = Mode.OBSERVE
        self.point_contact_pairs = 0
        self.done_since: float | None = None

    def step(self, root_context: Context) -> EventStatus:
        """Notifies the observers after a step, and decides whether the episode ends or pauses."""
        station = self._station
        self.tell(root_context)
        for sampler in self._samplers:
            sampler.sample(root_context)
        if self._pauses or self._end_at_success:
            asks = station.asks(root_context)
            if asks and self._end_at_success and station.reward(root_context) > ALL:
                self.done_since = root_context.get_time()
                return EventStatus.ReachedTermination(station, "every goal is filled")
            self.is_paused = asks and self._pauses
            if self.is_paused:
                return EventStatus.ReachedTermination(station, "the planner needs an action")
        if self._mode != Mode.DONE:
            return EventStatus.DidNothing()
        now = root_context.get_time()
        if self.done_since is None:
            self.done_since = now
        if station.at_rest(root_context).all() or now - self.done_since > _LAST_WAIT:
            return EventStatus.ReachedTermination(station, "the episode is over")
        return EventStatus.DidNothing()

    def tell(self, root_context: Context, *, is_last: bool = False) -> None:
        """Notifies the observers if the mode has changed or the episode is over."""
        previous, self._mode = self._mode, self._station.mode(root_context)
        if is_last or self._mode != previous:
            pairs = self._station.point_contact_pairs(root_context)
            self.point_contact_pairs = max(self.point_contact_pairs, pairs)
            event = ModeChange(
                self._mode if is_last else previous, self._mode, root_context, is_last
            )
            for observer in self._observers:
                observer(event)
