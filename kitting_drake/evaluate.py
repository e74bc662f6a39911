"""`python -m kitting_drake.evaluate SCENARIO.yaml`: many seeds side by side, and their summary."""

import functools
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.command_line import FAILED, count_type, run_command, seed_type
from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import (
    alone_in,
    append_line,
    claim_folder,
    files_digest,
    read_lines,
    require_folder,
    write_json,
)
from kitting_drake.common.processes import (
    ProcessCrashed,
    Workers,
    counting_bar,
    side_by_side,
)
from kitting_drake.common.provenance import commit, uncommitted_note, versions
from kitting_drake.common.seeds import ALL_SEEDS
from kitting_drake.episode import EpisodeResult
from kitting_drake.episode.chosen import build_any_chosen, build_chosen, run_chosen
from kitting_drake.episode.episode_log import add_log_flag, log_of_many, log_of_seed
from kitting_drake.evaluation.summary import Episode, summarise
from kitting_drake.evaluation.summary_figure import draw_summary
from kitting_drake.evaluation.terminal import summary_notes, summary_table
from kitting_drake.scenario.choosing import (
    ChosenScenario,
    choose_scenario,
    output_folder,
    scenario_parser,
)
from kitting_drake.scenario.workers import add_workers_flags, open_workers
from kitting_drake.station.hidden_table import hidden_table_note

Run = Callable[[int], Episode]
"""Runs the episode of a seed; called in a thread."""


def main() -> int:
    """Parses the command line and evaluates; returns the exit code."""
    parser = scenario_parser("evaluate", "Run episodes of many seeds and summarise them.")
    parser.add_argument("--episodes", type=count_type, default=100, help="how many (100)")
    add_workers_flags(parser)
    parser.add_argument("--seed", type=seed_type, help="of the first (default: the scenario's)")
    add_log_flag(parser)
    arguments = parser.parse_args()
    log = log_of_many(arguments.log, arguments.ray)
    chosen = choose_scenario(arguments)
    first = chosen.scenario.random_seed if arguments.seed is None else arguments.seed
    seeds = range(first, first + arguments.episodes)
    if seeds[-1] not in ALL_SEEDS:
        raise UserError(
            f"the seeds end at {ALL_SEEDS[-1]}: ask for fewer --episodes, or another --seed"
        )
    folder = require_folder(output_folder(arguments, f"{chosen.name}-evaluation"))
    console = Console(quiet=arguments.quiet)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)

    known = chosen.scenario.policy.training_seeds(chosen.base).intersection(seeds)
    if known:
        console.print(f"note: the policy has learned from seeds {min(known)} to {max(known)}")
    # What cannot be built at all is told at once, not once for each seed.
    success = build_any_chosen(chosen, seeds).scene.success
    if note := uncommitted_note():
        console.print(f"note: {note}", highlight=False, markup=False)
    with alone_in(folder):
        with open_workers(arguments, chosen) as (workers, sent):
            evaluation = evaluate(
                chosen,
                seeds,
                folder,
                lambda seed: run_in_worker(workers, sent, seed, log),
                workers=workers,
                console=console,
            )
        episodes = evaluation.episodes
        summary = summarise(
            episodes, chosen, success, wall_seconds_total=evaluation.wall_seconds_total
        )
        write_json(folder / "summary.json", summary)
        draw_summary(summary, episodes, folder / "summary.png")
    console.print(summary_table(summary))
    console.print(summary_notes(summary), highlight=False, markup=False)
    console.print(f"files: {folder}/", highlight=False, markup=False)
    failed = [episode for episode in episodes if episode["failure"]]
    if failed:
        console.print(
            f"failed first: seed {failed[0]['seed']}: {failed[0]['failure']}",
            highlight=False,
            markup=False,
        )
    return FAILED if len(failed) == len(episodes) else 0


@dataclass(frozen=True)
class Evaluation:
    """The result of `evaluate`."""

    episodes: list[Episode]
    """In the order of the seeds."""
    wall_seconds_total: float
    """The time of all calls that worked in the folder, in s."""


def evaluate(
    chosen: ChosenScenario,
    seeds: Iterable[int],
    folder: Path,
    run: Run,
    *,
    workers: Workers,
    console: Console,
) -> Evaluation:
    """Runs an episode for each seed.

    Episodes already in `folder/episodes.jsonl` are not run again; one is written there as it ends,
    with the commit of the code that ran it.

    Args:
        chosen: the scenario.
        seeds: one episode each.
        folder: where `episodes.jsonl` is; must not hold those of anything else.
        run: runs one; called in threads.
        workers: say how many run at a time.
        console: for the progress bar.

    Raises:
        UserError: the folder holds the episodes of another scenario, or of the same with another
            policy, other files or other versions; or a process was killed twice.
    """
    seeds = list(seeds)
    path = folder / "episodes.jsonl"
    claim_folder(folder, "scenario.json", _identity(chosen), of="scenario, policy or version")
    clock = _WallClock(folder / "wall_seconds.json")
    earlier = read_lines(path)
    if not all(isinstance(item, dict) and {"seed", "objects"} <= item.keys() for item in earlier):
        raise UserError(f"{path} is damaged: it has a line that is no episode")
    done = {episode["seed"]: episode for episode in earlier}
    pending = [seed for seed in seeds if seed not in done]
    queue = iter(pending)
    now = commit()
    with counting_bar(console, "episodes") as progress:
        task = progress.add_task("", total=len(seeds), completed=len(seeds) - len(pending))
        for episode in side_by_side(run, lambda: next(queue, None), workers=workers):
            # A worker tells that of its own code, where it has a checkout.
            episode["commit"] = episode.get("commit") or now
            done[episode["seed"]] = episode
            append_line(path, episode)
            clock.save()
            progress.advance(task)
    return Evaluation([done[seed] for seed in seeds], clock.save())


class _WallClock:
    """Measures the time of all calls that worked in a folder; a file keeps that of earlier ones.

    When a call is killed, the time since its last episode ended is not counted: the work of that
    time is lost too.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._earlier = 0.0
        self._start = time.perf_counter()
        if path.exists():
            try:
                self._earlier = float(json.loads(path.read_text())["wall_seconds_total"])
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise UserError(f"{path} is damaged: delete it") from error

    def save(self) -> float:
        """Writes the file; returns the time so far, in s."""
        total = self._earlier + time.perf_counter() - self._start
        write_json(self._path, {"wall_seconds_total": total})
        return total


def _identity(chosen: ChosenScenario) -> dict[str, Any]:
    """The identity of an evaluation: the whole scenario, digests of the files that it depends on,
    and versions."""
    scenario = chosen.scenario
    return {
        **chosen.described,
        "versions": versions(),
        "policy_digest": scenario.policy.digest(chosen.base),
        # Networks compute in what is faster on the machine: not the same to the last bit.
        "compute_type": scenario.policy.details(chosen.base).get("compute_type"),
        "task_digest": files_digest(scenario.task.input_files(chosen.base)),
    }


def run_in_worker(
    workers: Workers, chosen: ChosenScenario, seed: int, log: Path | None = None
) -> Episode:
    """Runs one episode in another process and waits for it.

    A process that dies leaves a failed episode with its reason; one that something else killed is
    given a second chance.

    Args:
        workers: where.
        chosen: the scenario as they find it.
        seed: the episode's.
        log: the file of which each seed has its own; see `log_of_seed`.

    Raises:
        UserError: the process was killed twice.
    """
    start = time.perf_counter()
    outcome = workers.run(_work, chosen, seed, log)
    if isinstance(outcome, ProcessCrashed) and outcome.was_killed:
        outcome = workers.run(_work, chosen, seed, log)
        if isinstance(outcome, ProcessCrashed) and outcome.was_killed:
            raise outcome.killed_twice(seed)
    if isinstance(outcome, ProcessCrashed):
        outcome = f"the process of the episode ended with exit code {outcome.exit_code}"
    if isinstance(outcome, str):
        return _lost_episode(chosen, seed, outcome, time.perf_counter() - start)
    return outcome


def _work(chosen: ChosenScenario, seed: int, log: Path | None) -> Episode | str:
    """An episode, or why there is none of this seed."""
    try:
        diagram, station = build_chosen(chosen, seed=seed)
    except MachineError:
        raise
    except UserError as error:
        return str(error)
    file = None if log is None else log_of_seed(log, seed)
    result = run_chosen(chosen, diagram, station, log=file)
    return result.as_dict() | {"commit": _commit_of_process()}


@functools.cache
def _commit_of_process() -> str | None:
    """The commit of the code that this process runs: as of its first episode."""
    return commit()


def _lost_episode(chosen: ChosenScenario, seed: int, failure: str, seconds: float) -> Episode:
    """The episode of which nothing is known but why it failed."""
    return EpisodeResult(
        scenario=chosen.name,
        policy=chosen.policy,
        seed=seed,
        objects=[],
        success_rate=0.0,
        strict_success_rate=0.0,
        actions=0,
        missed_grasps=0,
        dropped_objects=0,
        actions_taken=[],
        sim_seconds=0.0,
        wall_seconds=seconds,
        point_contact_pairs=0,
        moving_at_end=[],
        failure=failure,
        timed_out=False,
        interrupted=False,
    ).as_dict()


if __name__ == "__main__":
    run_command(main)
