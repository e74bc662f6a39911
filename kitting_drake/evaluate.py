"""`python -m kitting_drake.evaluate SCENARIO.yaml`: runs many seeds in parallel; summarises."""

import functools
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import FAILED, count_type, run_command, seed_type
from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import (
    alone_in,
    append_line,
    claim_folder,
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
from kitting_drake.common.provenance import commit, uncommitted_note
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
"""A function that runs the episode of a seed. It is called in threads."""


def main() -> int:
    """Parses the command line and evaluates; returns the exit code."""
    parser = scenario_parser(
        "evaluate", "Run episodes of many seeds in parallel and summarise them."
    )
    parser.add_argument("--episodes", type=count_type, default=100, help="number of episodes (100)")
    add_workers_flags(parser)
    parser.add_argument(
        "--seed", type=seed_type, help="seed of the first episode (default: the scenario's)"
    )
    add_log_flag(parser)
    arguments = parser.parse_args()
    log = log_of_many(arguments.log, arguments.ray)
    chosen = choose_scenario(arguments)
    first = chosen.scenario.random_seed if arguments.seed is None else arguments.seed
    seeds = range(first, first + arguments.episodes)
    if seeds[-1] not in ALL_SEEDS:
        raise UserError(f"the largest seed is {ALL_SEEDS[-1]}: give a smaller --episodes or --seed")
    folder = require_folder(output_folder(arguments, f"{chosen.name}-evaluation"))
    console = Console(quiet=arguments.quiet)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)

    known = chosen.scenario.policy.training_seeds(chosen.base).intersection(seeds)
    if known:
        console.print(f"note: the policy has learned from seeds {min(known)} to {max(known)}")
    # Fail before the episodes start if no scene can be built.
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
            f"first failure: seed {failed[0]['seed']}: {failed[0]['failure']}",
            highlight=False,
            markup=False,
        )
    return FAILED if len(failed) == len(episodes) else 0


@dataclass(frozen=True)
class Evaluation:
    """The result of `evaluate`."""

    episodes: list[Episode]
    """The episodes in the order of the seeds."""
    wall_seconds_total: float
    """The total wall-clock time of all commands that ran episodes for the output folder, in s."""


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

    Seeds whose episodes are already in `folder/episodes.jsonl` are not run again. Each new episode
    is appended when it ends, with the commit of the code that ran it.

    Args:
        chosen: the scenario.
        seeds: the seeds, one for each episode.
        folder: the folder of `episodes.jsonl`.
        run: a function that runs an episode; it is called in threads.
        workers: the processes that run episodes, whose number limits the parallel episodes.
        console: the console for the progress bar.

    Raises:
        UserError: the folder holds episodes of another scenario, policy, version or other input
            files, or a process was killed twice.
    """
    seeds = list(seeds)
    path = folder / "episodes.jsonl"
    claim_folder(folder, "scenario.json", chosen.identity(), of="scenario, policy or version")
    clock = _WallClock(folder / "wall_seconds.json")
    earlier = read_lines(path)
    if not all(isinstance(item, dict) and {"seed", "objects"} <= item.keys() for item in earlier):
        raise UserError(f"{path} is damaged: delete the line that is not an episode")
    done = {episode["seed"]: episode for episode in earlier}
    pending = [seed for seed in seeds if seed not in done]
    queue = iter(pending)
    now = commit()
    with counting_bar(console, "episodes") as progress:
        task = progress.add_task("", total=len(seeds), completed=len(seeds) - len(pending))
        for episode in side_by_side(run, lambda: next(queue, None), workers=workers):
            # Keep a commit that the worker recorded: the worker may have its own checkout.
            episode["commit"] = episode.get("commit") or now
            done[episode["seed"]] = episode
            append_line(path, episode)
            clock.save()
            progress.advance(task)
    return Evaluation([done[seed] for seed in seeds], clock.save())


class _WallClock:
    """Measures the total wall-clock time of all commands that ran in a folder, and saves it in a
    file.

    If a command is killed, the time since its last finished episode is not counted.
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
        """Writes the file; returns the total time, in s."""
        total = self._earlier + time.perf_counter() - self._start
        write_json(self._path, {"wall_seconds_total": total})
        return total


def run_in_worker(
    workers: Workers, chosen: ChosenScenario, seed: int, log: Path | None = None
) -> Episode:
    """Runs one episode in another process and waits for it.

    If the process crashes, a failed episode with the reason is returned. If it is killed from
    outside, it is started once more.

    Args:
        workers: the workers that start the process.
        chosen: the scenario, with paths that are valid for the workers.
        seed: the seed of the episode.
        log: the log file, whose name gets the seed (see `log_of_seed`); None for no log.

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
    """Returns the episode, or the reason why its scene cannot be built."""
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
    """Returns the commit of the running code. It is read once, at this process's first episode."""
    return commit()


def _lost_episode(chosen: ChosenScenario, seed: int, failure: str, seconds: float) -> Episode:
    """Makes the result of an episode whose process ended without one; `failure` is the reason."""
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
        stopped_actions=0,
        actions_taken=[],
        sim_seconds=0.0,
        wall_seconds=seconds,
        point_contact_pairs=0,
        moving_at_end=[],
        failure=failure,
        timed_out=False,
        interrupted=False,
        stop_reason="failure",
    ).as_dict()


if __name__ == "__main__":
    run_command(main)
