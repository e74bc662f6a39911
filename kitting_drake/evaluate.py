"""`python -m kitting_drake.evaluate SCENARIO.yaml`: many seeds side by side, and their summary."""

import dataclasses
import json
import math
import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from kitting_drake.cli import (
    ChosenScenario,
    build_chosen,
    choose_scenario,
    count_type,
    output_folder,
    run_verb,
    scenario_parser,
    seed_type,
)
from kitting_drake.episode import run_episode
from kitting_drake.errors import UserError
from kitting_drake.files import require_folder, write_json

Episode = dict[str, Any]
"""A line of `episodes.jsonl`: what `EpisodeResult.as_dict` gives."""


def main() -> int:
    """Parses the command line and evaluates; returns the exit code."""
    parser = scenario_parser("evaluate", "Kit with many seeds and summarise.")
    parser.add_argument("--episodes", type=count_type, default=100, help="how many (100)")
    parser.add_argument("--workers", type=count_type, default=os.cpu_count(), help="side by side")
    parser.add_argument("--seed", type=seed_type, help="of the first (default: the scenario's)")
    arguments = parser.parse_args()
    chosen = choose_scenario(arguments)
    first = chosen.scenario.random_seed if arguments.seed is None else arguments.seed
    seeds = range(first, first + arguments.episodes)
    folder = require_folder(output_folder(arguments, f"{chosen.name}-evaluation"))
    console = Console(quiet=arguments.quiet)

    # What cannot be built at all is told at once, not once for each seed.
    build_chosen(chosen, seed=seeds[0])
    episodes = evaluate(chosen, seeds, folder, workers=arguments.workers, console=console)
    summary = summarise(episodes, chosen)
    write_json(folder / "summary.json", summary)
    console.print(summary_table(summary, episodes))
    console.print(f"files: {folder}/", highlight=False)
    return 0


def evaluate(
    chosen: ChosenScenario, seeds: Iterable[int], folder: Path, *, workers: int, console: Console
) -> list[Episode]:
    """Runs an episode for each seed, each in a process of its own.

    Episodes already in `folder/episodes.jsonl` are not run again; one is written there as it ends.
    A process that dies leaves a failed episode with its reason.

    Args:
        chosen: the scenario.
        seeds: one episode each.
        folder: where `episodes.jsonl` is; must not hold those of another scenario.
        workers: how many run at a time.
        console: for the progress bar.

    Returns:
        The episodes, in the order of the seeds.

    Raises:
        UserError: the folder holds another scenario's episodes.
    """
    seeds = list(seeds)
    path = folder / "episodes.jsonl"
    _claim(folder, chosen)
    done = {episode["seed"]: episode for episode in _read_lines(path)}
    pending = [seed for seed in seeds if seed not in done]
    progress = Progress(
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    pool = ThreadPoolExecutor(workers)
    try:
        with progress:
            task = progress.add_task("", total=len(seeds), completed=len(seeds) - len(pending))
            futures = [pool.submit(_run_apart, chosen, seed) for seed in pending]
            for future in as_completed(futures):
                episode = future.result()
                done[episode["seed"]] = episode
                _append_line(path, episode)
                progress.advance(task)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return [done[seed] for seed in seeds]


def _claim(folder: Path, chosen: ChosenScenario) -> None:
    described = json.loads(json.dumps(dataclasses.asdict(chosen.scenario), default=str))
    path = folder / "scenario.json"
    if path.exists() and json.loads(path.read_text()) != described:
        raise UserError(
            f"{folder} holds the episodes of another scenario: give another --output, or delete it"
        )
    write_json(path, described)


def _read_lines(path: Path) -> Iterator[Episode]:
    if not path.exists():
        return
    content = path.read_text()
    # A line that was being written when the process was killed has no end.
    whole = content[: content.rfind("\n") + 1]
    if whole != content:
        path.write_text(whole)
    for line in whole.splitlines():
        yield json.loads(line)


def _append_line(path: Path, episode: Episode) -> None:
    with path.open("a") as file:
        file.write(json.dumps(episode) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _run_apart(chosen: ChosenScenario, seed: int) -> Episode:
    """Runs one episode in a fresh process and waits for it."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(chosen, seed, sender), daemon=True)
    start = time.perf_counter()
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        process.join()
        return _lost_episode(chosen, seed, process.exitcode, time.perf_counter() - start)
    finally:
        process.join()


def _work(chosen: ChosenScenario, seed: int, sender: Connection) -> None:
    # Ctrl-C is the parent's to handle.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cell = build_chosen(chosen, seed=seed)
    result = run_episode(
        cell,
        scenario=chosen.name,
        policy=chosen.policy,
        seed=seed,
        time_limit=chosen.scenario.time_limit,
    )
    sender.send(result.as_dict())


def _lost_episode(
    chosen: ChosenScenario, seed: int, exit_code: int | None, seconds: float
) -> Episode:
    return {
        "scenario": chosen.name,
        "policy": chosen.policy,
        "seed": seed,
        "objects": [],
        "success_rate": 0.0,
        "actions": 0,
        "missed_grasps": 0,
        "dropped_objects": 0,
        "sim_seconds": 0.0,
        "wall_seconds": seconds,
        "point_contact_pairs": 0,
        "failure": f"the process of the episode ended with exit code {exit_code}",
        "timed_out": False,
        "interrupted": False,
    }


def summarise(episodes: list[Episode], chosen: ChosenScenario) -> dict[str, Any]:
    """What `summary.json` holds.

    The success rate is the mean of the episodes' scores, failed episodes counting 0. Its interval
    is Wilson's, over as many trials as there were objects. Error statistics are over all objects
    of the episodes that did not fail, missed ones included.
    """
    objects = [
        item for episode in episodes if not episode["failure"] for item in episode["objects"]
    ]
    per_episode = max((len(episode["objects"]) for episode in episodes), default=1)
    rate = float(np.mean([episode["success_rate"] for episode in episodes]))
    return {
        "scenario": chosen.name,
        "policy": chosen.policy,
        "seeds": [episode["seed"] for episode in episodes],
        "episodes": len(episodes),
        "failed_episodes": sum(bool(episode["failure"]) for episode in episodes),
        "success_rate": rate,
        "ci95": wilson_interval(rate, len(episodes) * max(per_episode, 1)),
        **{
            key: _spread([abs(item[key]) for item in objects])
            for key in ("add_s_mm", "position_error_mm", "angle_error_deg", "height_error_mm")
        },
        "missed_grasps": sum(episode["missed_grasps"] for episode in episodes),
        "dropped_objects": sum(episode["dropped_objects"] for episode in episodes),
        "point_contact_pairs": max(episode["point_contact_pairs"] for episode in episodes),
        "sim_seconds": sum(episode["sim_seconds"] for episode in episodes),
        "wall_seconds": sum(episode["wall_seconds"] for episode in episodes),
    }


def wilson_interval(rate: float, trials: int) -> list[float]:
    """Wilson's 95 % score interval of a proportion."""
    z = 1.959964
    centre = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials**2))
    half /= 1 + z * z / trials
    return [max(0.0, centre - half), min(1.0, centre + half)]


def _spread(values: list[float]) -> dict[str, float | None]:
    if not values:
        return {"median": None, "p95": None, "max": None}
    return {
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(np.max(values)),
    }


def summary_table(summary: dict[str, Any], episodes: list[Episode]) -> Table:
    """The summary for the terminal: a row for each category."""
    low, high = summary["ci95"]
    table = Table(
        title=f"{summary['scenario']} by {summary['policy']}: {summary['episodes']} episodes, "
        f"{summary['success_rate']:.1%} kitted (95 %: {low:.1%} to {high:.1%}), "
        f"{summary['failed_episodes']} failed",
        title_justify="left",
    )
    table.add_column("category")
    for heading in ("kitted", "ADD-S mm", "95 %", "position mm", "angle deg", "height mm"):
        table.add_column(heading, justify="right")
    objects = [item for episode in episodes for item in episode["objects"]]
    categories = dict.fromkeys(item["category"] for item in objects)
    for category in [*categories, "all"]:
        rows = [item for item in objects if category in (item["category"], "all")]
        if rows:
            errors = [
                f"{np.median([abs(row[key]) for row in rows]):.2f}"
                for key in ("position_error_mm", "angle_error_deg", "height_error_mm")
            ]
            add_s = [row["add_s_mm"] for row in rows]
            table.add_row(
                category,
                f"{sum(row['success'] for row in rows)}/{len(rows)}",
                f"{np.median(add_s):.2f}",
                f"{np.percentile(add_s, 95):.2f}",
                *errors,
            )
    return table


if __name__ == "__main__":
    run_verb(main)
