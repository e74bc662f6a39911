"""Runs scene after scene without a person, until a simulated work shift is over (`benchmark
endurance`).

A unit is a tool that is placed strictly. An assist is an object that is not placed strictly, so a
person must put it right at the end of the scene: the policy gave it up, it is misplaced, or it is
off the table. In a scene that fails or times out, every object is an assist. The person puts
objects right while the kits are exchanged.

A cycle is the simulated time from one unit to the next within a scene, failed actions included. The
first cycle begins with the scene. A unit is finished when the hand has retreated.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from scipy import stats

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import append_line, claim_folder, read_lines
from kitting_drake.common.processes import ProcessCrashed, Workers, side_by_side
from kitting_drake.common.provenance import commit
from kitting_drake.episode import EpisodeResult, ModeChange
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.episode.episode import ObjectResult
from kitting_drake.evaluation.summary import FAILED, TIMED_OUT, find_ambiguities
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.station import KittingStation
from kitting_drake.tasks.task import TABLE
from systems.pick_place_parameters import Mode

HOUR = 3600.0
OFF_TABLE = "off the table"
_LINES = "scenes.jsonl"
_MOST_LOST = 20
"""The shift is aborted after this number of scenes in a row that could not begin."""
_BELOW = 0.05
"""An object whose origin is deeper than this below the table's top, in m, has fallen off the
table."""
_WIDTH = 0.5
"""The width of the bins of the histogram of cycles, in s."""


@dataclass
class ShiftScene:
    """A scene of the shift. Its field names are the keys of a line of `scenes.jsonl`."""

    seed: int
    sim_seconds: float
    tools: int
    """The number of objects that had a free goal at the start."""
    unit_seconds: list[float] = field(default_factory=list)
    """The time at which each unit was finished, in s from the start of the scene."""
    assists: dict[str, str] = field(default_factory=dict)
    """The cause of each assist, by object."""
    actions: int = 0
    missed_grasps: int = 0
    dropped_objects: int = 0
    stopped_actions: int = 0
    stop_reason: str = "failure"
    failure: str | None = None
    wall_seconds: float = 0.0
    commit: str | None = None

    def cycles(self) -> list[float]:
        """Returns, for each unit, the time since the previous unit (or the scene's start), in s."""
        return np.diff(self.unit_seconds, prepend=0.0).tolist()


def run_shift(
    chosen: ChosenScenario,
    hours: float,
    exchange: float,
    seed: int,
    folder: Path,
    *,
    workers: Workers,
    sent: ChosenScenario,
    console: Console,
) -> list[ShiftScene]:
    """Runs those scenes of a shift that `folder/scenes.jsonl` lacks, and appends each to the file.

    Args:
        chosen: the scenario.
        hours: the simulated length of the shift. The scene in progress at its end is finished.
        exchange: the time between two scenes, in s.
        seed: the seed of the first scene; the scenes have successive seeds.
        folder: the folder of `scenes.jsonl`.
        workers: the processes that run the scenes.
        sent: the scenario with paths that are valid for the workers.
        console: the console for the progress.

    Returns:
        The scenes of the shift, in the order of the seeds.

    Raises:
        UserError: the folder holds the scenes of another shift, a process was killed twice, or many
            scenes in a row could not begin.
    """
    identity = {**chosen.identity(), "first_seed": seed}
    claim_folder(folder, "scenario.json", identity, of="scenario, policy, version or first seed")
    path = folder / _LINES
    try:
        done = {item["seed"]: ShiftScene(**item) for item in read_lines(path)}
    except (TypeError, KeyError) as error:
        raise UserError(f"{path} is damaged: a line is not a scene") from error
    wanted = hours * HOUR
    working: set[int] = set()

    def draw() -> int | None:
        if _length(_shift(done, seed, wanted, exchange), exchange) >= wanted:
            return None
        chosen_seed = next(n for n in _from(seed) if n not in done and n not in working)
        working.add(chosen_seed)
        return chosen_seed

    with _progress(console) as progress:
        task = progress.add_task("", total=wanted, text="")
        _show(progress, task, _shift(done, seed, wanted, exchange), exchange, hours)
        for scene in side_by_side(lambda n: _in_worker(workers, sent, n), draw, workers=workers):
            done[scene.seed] = scene
            append_line(path, asdict(scene))
            shift = _shift(done, seed, wanted, exchange)
            _show(progress, task, shift, exchange, hours)
            _check_begun(shift)
    return _shift(done, seed, wanted, exchange)


def _check_begun(scenes: Sequence[ShiftScene]) -> None:
    last = scenes[-_MOST_LOST:]
    if len(last) == _MOST_LOST and not any(scene.sim_seconds for scene in last):
        raise UserError(
            f"{_MOST_LOST} scenes in a row could not begin, the last with seed {last[-1].seed}: "
            f"{last[-1].failure}"
        )


def _from(seed: int) -> Iterable[int]:
    while True:
        yield seed
        seed += 1


def _shift(
    done: dict[int, ShiftScene], seed: int, wanted: float, exchange: float
) -> list[ShiftScene]:
    """Returns the finished scenes from the first seed on, up to the end of the shift or up to the
    first missing scene."""
    scenes: list[ShiftScene] = []
    total = 0.0
    for number in _from(seed):
        if number not in done or total >= wanted:
            return scenes
        scenes.append(done[number])
        total += done[number].sim_seconds + exchange
    raise AssertionError


def _length(scenes: Sequence[ShiftScene], exchange: float) -> float:
    return sum(scene.sim_seconds + exchange for scene in scenes)


def _progress(console: Console) -> Progress:
    return Progress(
        BarColumn(),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def _show(
    progress: Progress,
    task: Any,
    scenes: Sequence[ShiftScene],
    exchange: float,
    hours: float,
) -> None:
    length = _length(scenes, exchange)
    units = sum(len(scene.unit_seconds) for scene in scenes)
    assists = sum(len(scene.assists) for scene in scenes)
    text = f"{length / HOUR:.2f} of {hours:g} h, {units} units, {assists} assists"
    progress.update(task, completed=length, text=text)


def _in_worker(workers: Workers, chosen: ChosenScenario, seed: int) -> ShiftScene:
    """Runs a scene in a worker process, and once more if that process is killed from outside."""
    start = time.perf_counter()
    outcome = workers.run(_run_scene, chosen, seed)
    if isinstance(outcome, ProcessCrashed) and outcome.was_killed:
        outcome = workers.run(_run_scene, chosen, seed)
        if isinstance(outcome, ProcessCrashed) and outcome.was_killed:
            raise outcome.killed_twice(seed)
    if not isinstance(outcome, ProcessCrashed):
        return outcome
    why = f"the process of the scene ended with exit code {outcome.exit_code}"
    return _lost(seed, why, time.perf_counter() - start)


def _lost(seed: int, why: str, wall_seconds: float = 0.0) -> ShiftScene:
    """Makes the record of a scene that failed without a result. Only the reason is known, and the
    scene counts as one assist."""
    scene = ShiftScene(seed, 0.0, tools=0, assists={"scene": FAILED}, failure=why)
    scene.wall_seconds, scene.commit = wall_seconds, commit()
    return scene


def _run_scene(chosen: ChosenScenario, seed: int) -> ShiftScene:
    try:
        diagram, station = build_chosen(chosen, seed=seed)
    except MachineError:
        raise
    except UserError as error:
        return _lost(seed, str(error))
    watch = _Watch(station)
    result = run_chosen(chosen, diagram, station, observers=[watch.observe])
    return shift_scene(result, watch.ends, watch.off_table)


class _Watch:
    """An `EpisodeObserver` that records when actions end and which objects have fallen off the
    table."""

    def __init__(self, station: KittingStation) -> None:
        self._station = station
        self.ends: list[float] = []
        """The time at which the hand had retreated after each action, in s."""
        self.off_table: set[str] = set()

    def observe(self, event: ModeChange) -> None:
        now = event.root_context.get_time()
        if event.is_action_start:
            self.ends.append(now)
        elif self.ends and (event.is_last or event.previous not in (Mode.OBSERVE, Mode.DONE)):
            self.ends[-1] = now
        if event.is_last:
            poses = self._station.object_poses(event.root_context)
            names = [item.name for item in self._station.scene.objects]
            places = [X_WB.translation() for X_WB in poses]
            self.off_table = {
                name for name, p in zip(names, places, strict=True) if not is_on_table(p)
            }


def is_on_table(p_WB: Any) -> bool:
    """Whether a point (3,) is within the table's sides, and above or at most `_BELOW` below the
    table's top. Returns False for NaN."""
    low, high = TABLE
    return bool(np.all(p_WB[:2] >= low) and np.all(p_WB[:2] <= high) and p_WB[2] > -_BELOW)


def shift_scene(
    result: EpisodeResult, ends: Sequence[float], off_table: Iterable[str] = ()
) -> ShiftScene:
    """Makes the record of a scene from its episode.

    Args:
        result: the result of the scene's episode.
        ends: the time at which each action was finished, in s.
        off_table: the names of the objects that lie off the table.
    """
    counted = [item for item in result.objects if item.add_s_mm is not None]
    lost = FAILED if result.failure else TIMED_OUT if result.timed_out else None
    finished = {record.object: end for record, end in zip(result.actions_taken, ends, strict=False)}
    kitted = [item for item in counted if item.strict_success and lost is None]
    names = {item.name for item in kitted}
    assists = {
        item.name: lost or _cause(item, off_table) for item in counted if item.name not in names
    }
    if lost is not None and not assists:
        assists = {"scene": lost}
    return ShiftScene(
        seed=result.seed,
        sim_seconds=result.sim_seconds,
        tools=len(counted),
        unit_seconds=sorted(finished.get(item.name, result.sim_seconds) for item in kitted),
        assists=assists,
        actions=result.actions,
        missed_grasps=result.missed_grasps,
        dropped_objects=result.dropped_objects,
        stopped_actions=result.stopped_actions,
        stop_reason=result.stop_reason,
        failure=result.failure,
        wall_seconds=result.wall_seconds,
        commit=commit(),
    )


def _cause(item: ObjectResult, off_table: Iterable[str]) -> str:
    if item.name in off_table:
        return OFF_TABLE
    return item.cause or ", ".join(find_ambiguities(asdict(item))) or "not strict"


def summarise_shift(
    scenes: Sequence[ShiftScene], chosen: ChosenScenario, exchange: float
) -> dict[str, Any]:
    """Returns the content of `endurance.json`.

    Rates are over the whole shift, including the exchanges of kits. The 95 % interval of the time
    between assists assumes that assists are independent (a Poisson process).

    Args:
        scenes: the scenes of the shift; at least one.
        chosen: the scenario.
        exchange: the time between two scenes, in s.
    """
    total, working = _length(scenes, exchange), _length(scenes, 0.0)
    causes = Counter(cause for scene in scenes for cause in scene.assists.values())
    units, assists = sum(len(scene.unit_seconds) for scene in scenes), causes.total()
    cycles = np.array([cycle for scene in scenes for cycle in scene.cycles()])
    counted: dict[str, Callable[[ShiftScene], int]] = {
        "tools": lambda scene: scene.tools,
        "actions": lambda scene: scene.actions,
        "missed_grasps": lambda scene: scene.missed_grasps,
        "dropped_objects": lambda scene: scene.dropped_objects,
        "stopped_actions": lambda scene: scene.stopped_actions,
        "failed_scenes": lambda scene: scene.failure is not None,
        "timed_out_scenes": lambda scene: scene.stop_reason == "time",
    }
    return {
        "scenario": chosen.name,
        "policy": {"name": chosen.policy, **chosen.scenario.policy.details(chosen.base)},
        "perturbed": chosen.perturbed,
        "text": chosen.text,
        "hours": total / HOUR,
        "exchange_seconds": exchange,
        "scenes": len(scenes),
        "first_seed": scenes[0].seed,
        "units": units,
        "units_per_hour": units / (total / HOUR),
        "units_per_hour_without_exchange": units / (working / HOUR) if working else None,
        "assists": assists,
        "minutes_between_assists": total / 60 / assists if assists else None,
        "minutes_between_assists_ci95": _between(total / 60, assists),
        "causes": dict(causes.most_common()),
        "cycle_seconds": _distribution(cycles),
        **{name: sum(map(count, scenes)) for name, count in counted.items()},
        "wall_seconds": sum(scene.wall_seconds for scene in scenes),
        "commits": sorted({scene.commit for scene in scenes if scene.commit}),
        "resolved_scenario": chosen.described,
    }


def _between(minutes: float, assists: int) -> list[float | None]:
    """Returns the exact 95 % interval of the mean time between assists, in minutes.

    The assists are assumed to be a Poisson process.
    """
    most = stats.chi2.ppf(0.975, 2 * assists + 2) / 2
    least = stats.chi2.ppf(0.025, 2 * assists) / 2 if assists else 0.0
    return [float(minutes / most), float(minutes / least) if least else None]


def _distribution(cycles: Any) -> dict[str, Any]:
    """Returns the median, 95th percentile, maximum and histogram of cycles, in s."""
    if not len(cycles):
        return {"median": None, "p95": None, "max": None, "bin_width": _WIDTH, "histogram": []}
    bins = np.bincount((cycles / _WIDTH).astype(int))
    return {
        "median": float(np.median(cycles)),
        "p95": float(np.percentile(cycles, 95)),
        "max": float(np.max(cycles)),
        "bin_width": _WIDTH,
        "histogram": bins.tolist(),
    }
