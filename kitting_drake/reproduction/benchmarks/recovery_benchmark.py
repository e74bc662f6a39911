"""Measures how a policy recovers from a failed action (`benchmark recovery`).

The first action of each episode is made to fail in one of three ways: the object is moved while the
hand comes down, the grasp is displaced, or the place is displaced. The benchmark counts how often
this object is in its cavity in the end. It also counts how often an object that was in its cavity
is picked again, or is not in its cavity in the end. Episodes without an induced failure are the
baseline.
"""

import dataclasses
import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import cKDTree

from kitting_drake.common.errors import UserError
from kitting_drake.episode import ModeChange
from kitting_drake.episode.action_log import nearest_object
from kitting_drake.episode.chosen import run_chosen
from kitting_drake.evaluation.action_strip import ActionStrip, StripFrame, draw_strips
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.station import KittingStation, build_station, connect_policy, make_policy
from systems.pick_place_parameters import Mode
from systems.signals import PickPlaceAction, PlanarPose
from systems.weak_calc import weak_calc

_MOVED = (0.03, 0.06)
"""The smallest and the largest distance by which an object is moved, in metres."""
_MOVED_YAW = math.radians(45)
"""The largest angle by which a moved object is turned, in radians."""
_MISSED = 0.04
"""The error of a grasp that is made to fail, in metres."""
_BLOCKED = 0.003
"""The error of a place that is made to fail, in metres."""
_ROOM = 0.012
"""The least distance of a moved object from all other objects, in metres."""
_INSIDE = 0.02
"""The least distance of a moved object from the border of o_t, in metres."""
_DRAWS = 200


class Disturbance(enum.Enum):
    """The way in which the first action of an episode is made to fail."""

    NONE = "nothing"
    MOVED = "object moved"
    MISSED = "grasp off by 40 mm"
    BLOCKED = "place off by 3 mm"


class ActionOffset(LeafSystem):
    """A LeafSystem that shifts the poses of an action.

    .. pydrake_system::

        name: ActionOffset
        input_ports:
        - action
        output_ports:
        - action

    Both ports are abstract, of type `PickPlaceAction`. The numeric parameter 0 has the shifts of
    pick x, pick y, place x and place y, in metres. If all are zero, the action passes unchanged.
    """

    def __init__(self, offset: NDArray[np.float64]) -> None:
        """Declares the ports and the parameter.

        Args:
            offset: (4,) the initial value of the parameter.
        """
        super().__init__()
        self._action = self.DeclareAbstractInputPort("action", Value(PickPlaceAction()))
        self._offset = self.DeclareNumericParameter(BasicVector(offset))
        self.DeclareAbstractOutputPort(
            "action", lambda: Value(PickPlaceAction()), weak_calc(self._calc)
        )

    def stop(self, context: Context) -> None:
        """Sets all shifts to zero."""
        context.get_mutable_numeric_parameter(self._offset).SetFromVector(np.zeros(4))

    def _calc(self, context: Context, output: Any) -> None:
        action: PickPlaceAction = self._action.Eval(context)
        offset = context.get_numeric_parameter(self._offset).value()
        if action.stop or action.press or not offset.any():
            output.set_value(action)
            return
        output.set_value(
            dataclasses.replace(
                action,
                pick=_shifted(action.pick, offset[:2]),
                place=_shifted(action.place, offset[2:]),
            )
        )


def _shifted(pose: PlanarPose, offset: NDArray[np.float64]) -> PlanarPose:
    return PlanarPose(pose.x + float(offset[0]), pose.y + float(offset[1]), pose.theta)


class _Adversary:
    """An `EpisodeObserver` that makes the first action fail. It also records which objects are in
    their cavities, and which are picked again from there."""

    def __init__(
        self,
        station: KittingStation,
        kind: Disturbance,
        offset: ActionOffset,
        shift: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> None:
        self._station, self._kind, self._rng = station, kind, rng
        self._offset, self._shift = offset, shift
        self._actions = 0
        self.victim: int | None = None
        """The object whose action fails; None if no disturbance was possible."""
        self.seated: set[int] = set()
        """The objects that were in their cavities when an action began."""
        self.touched: set[int] = set()
        """The objects that an action picked although they were in their cavities."""

    def observe(self, event: ModeChange) -> None:
        if event.is_last:
            return
        if event.is_action_start:
            self._begin(event.root_context)
        elif self._actions != 1:
            return
        elif event.mode == Mode.DESCEND and self._kind == Disturbance.MOVED:
            self._move(event.root_context)
        elif event.mode == Mode.RETREAT:
            self._offset.stop(self._offset.GetMyContextFromRoot(event.root_context))

    def _begin(self, root_context: Context) -> None:
        station, movable = self._station, self._station.scene.goal_objects
        self._actions += 1
        pick = station.accepted_action(root_context).pick
        if self._actions == 1:
            pick = _shifted(pick, -self._shift[:2])
        wanted = nearest_object(station, station.object_poses(root_context), pick)
        if self._actions == 1:
            self.victim = wanted if wanted in movable else None
        placements = station.placements(root_context)
        seated = {i for i in movable if placements[i].strict_success}
        self.seated |= seated
        self.touched |= seated & {wanted}

    def _move(self, root_context: Context) -> None:
        """Moves the victim to another place on the table; clears `victim` if there is no room."""
        station, rng = self._station, self._rng
        if self.victim is None:
            return
        poses = station.object_poses(root_context)
        clouds = [
            (X @ item.p_BPoints.T).T[:, :2] for X, item in zip(poses, station.objects, strict=True)
        ]
        own = clouds.pop(self.victim)
        clouds += [
            (X @ station.objects[goal.objects[0]].p_BPoints.T).T[:, :2]
            for goal in station.scene.goals
            for X in goal.poses
        ]
        others = cKDTree(np.concatenate(clouds))
        middle = own.mean(axis=0)
        grid = station.grid
        low = np.array([grid.x_min, grid.y_min]) + _INSIDE
        high = low + grid.resolution * np.array(grid.shape) - 2 * _INSIDE
        for _ in range(_DRAWS):
            way, turn = rng.uniform(0, math.tau), rng.uniform(-_MOVED_YAW, _MOVED_YAW)
            shift = rng.uniform(*_MOVED) * np.array([math.cos(way), math.sin(way)])
            R = RollPitchYaw(0, 0, turn).ToRotationMatrix()
            there = (own - middle) @ R.matrix()[:2, :2].T + middle + shift
            outside = np.any(there < low) or np.any(there > high)
            if outside or others.query(there)[0].min() < _ROOM:
                continue
            about = np.append(middle, 0.0)
            X = RigidTransform(about + [*shift, 0.0]) @ RigidTransform(R, -(R @ about))
            plant = station.plant
            context = plant.GetMyMutableContextFromRoot(root_context)
            body = plant.get_body(station.objects[self.victim].body)
            plant.SetFreeBodyPose(context, body, X @ poses[self.victim])
            return
        self.victim = None


_Strip = tuple[str, Sequence[StripFrame], Sequence[str]]


@dataclass
class _Count:
    """Sums over all episodes with one kind of disturbance."""

    recovered: int = 0
    """The number of `disturbed` episodes in which the affected object was in its cavity in the
    end."""
    disturbed: int = 0
    """The number of episodes in which an object's action was made to fail."""
    kitted: int = 0
    objects: int = 0
    touched: int = 0
    """The number of `seated` objects that were picked again, or were not in their cavities in the
    end."""
    seated: int = 0
    """The number of objects that were in their cavities when an action began."""
    actions: int = 0
    failed: int = 0
    """The number of failed episodes. All of their objects count as not placed."""
    timed_out: int = 0
    """The number of episodes that timed out. All of their objects count as not placed."""


def benchmark_recovery(
    chosen: ChosenScenario, episodes: int, seed: int, console: Console
) -> tuple[dict[str, Any], bytes]:
    """Runs episodes with each kind of disturbance.

    Args:
        chosen: the scenario with the tested policy.
        episodes: the number of episodes with each disturbance.
        seed: the first of the successive seeds.
        console: the console for the progress.

    Returns:
        The counts, and a PNG with the frames of one episode for each disturbance: the episode with
            the most actions among those in which all objects were placed.

    Raises:
        UserError: the scenario has no cameras for the frames, or the scene of a seed cannot be
            built.
    """
    if not chosen.scenario.cameras:
        raise UserError(
            f"{chosen.path}: cameras is empty: the frames of episodes need at least one camera"
        )
    counts = {kind: _Count() for kind in Disturbance}
    strips: dict[Disturbance, _Strip] = {}
    runs = [(kind, seed + number) for kind in Disturbance for number in range(episodes)]
    for kind, number in track(runs, "episodes", console=console, disable=console.quiet):
        strip = _run(chosen, kind, number, counts[kind])
        if strip is not None and len(strip[1]) > len(strips.get(kind, ("", (), ()))[1]):
            strips[kind] = strip
    measured = {
        "episodes": episodes,
        "seed": seed,
        "policy": {"name": chosen.policy, **chosen.scenario.policy.details(chosen.base)},
        "disturbances": {kind.value: dataclasses.asdict(count) for kind, count in counts.items()},
    }
    return measured, draw_strips(list(strips.values())) if strips else b""


def _build(
    chosen: ChosenScenario, seed: int, shift: NDArray[np.float64]
) -> tuple[Diagram, KittingStation, ActionOffset]:
    """Builds a station whose policy's actions pass through an `ActionOffset`."""
    builder = DiagramBuilder()
    with chosen.named_in_errors():
        station = builder.AddSystem(build_station(chosen.scenario, seed, chosen.base))
        policy = builder.AddSystem(make_policy(station))
        offset = builder.AddSystem(ActionOffset(shift))
        connect_policy(builder, station, policy, through=offset)
    return builder.Build(), station, offset


def _run(chosen: ChosenScenario, kind: Disturbance, seed: int, count: _Count) -> _Strip | None:
    """Runs an episode and counts its outcome; returns its frames if all objects were placed."""
    rng = np.random.default_rng([seed, list(Disturbance).index(kind)])
    way = rng.uniform(0, math.tau)
    direction = np.array([math.cos(way), math.sin(way)])
    shift = np.zeros(4)
    if kind == Disturbance.MISSED:
        shift[:2] = _MISSED * direction
    elif kind == Disturbance.BLOCKED:
        shift[2:] = _BLOCKED * direction
    diagram, station, offset = _build(chosen, seed, shift)
    adversary = _Adversary(station, kind, offset, shift, rng)
    strip = ActionStrip(station)
    observers = [adversary.observe, strip.observe]
    result = run_chosen(chosen, diagram, station, observers=observers)
    count.failed += bool(result.failure)
    count.timed_out += result.timed_out
    lost = bool(result.failure) or result.timed_out
    strict = {item.name for item in result.objects if item.strict_success and not lost}
    if adversary.victim is not None and kind != Disturbance.NONE:
        count.disturbed += 1
        count.recovered += station.scene.objects[adversary.victim].name in strict
    ended = {i for i in station.scene.goal_objects if station.scene.objects[i].name in strict}
    count.kitted += len(strict)
    count.objects += len(result.objects)
    if not lost:
        count.seated += len(adversary.seated)
        count.touched += len(adversary.touched | (adversary.seated - ended))
    count.actions += result.actions
    if len(strict) < len(result.objects):
        return None
    return kind.value, strip.frames, [record.outcome for record in result.actions_taken]


def recovery_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the measurements."""
    table = Table(title=f"{measured['policy']['name']}: {measured['episodes']} episodes each")
    columns = ("recovered", "kitted in all", "disturbed again", "actions", "failed, timed out")
    table.add_column("the first action")
    for column in columns:
        table.add_column(column, justify="right")
    for name, count in measured["disturbances"].items():
        table.add_row(
            name,
            _share(count["recovered"], count["disturbed"]),
            _share(count["kitted"], count["objects"]),
            _share(count["touched"], count["seated"]),
            str(count["actions"]),
            f"{count['failed']}, {count['timed_out']}",
        )
    return table


def _share(part: int, whole: int) -> str:
    if not whole:
        return "-"
    low, high = proportion_interval(part, whole)
    return f"{part}/{whole}, {100 * part / whole:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
