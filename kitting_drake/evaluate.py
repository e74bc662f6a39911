"""`python -m kitting_drake.evaluate SCENARIO.yaml`: many seeds side by side, and their summary."""

import copy
import hashlib
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.command_line import FAILED, count_type, run_verb, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import (
    alone_in,
    append_line,
    claim_folder,
    read_lines,
    require_folder,
    write_json,
)
from kitting_drake.common.processes import Died, counting_bar, run_apart, side_by_side
from kitting_drake.episode.episode import run_episode
from kitting_drake.hkd.tools.tool import load_tool
from kitting_drake.reporting.summary import Episode, summarise, summary_notes, summary_table
from kitting_drake.reporting.summary_figure import draw_summary
from kitting_drake.scenario.command_line import (
    ChosenScenario,
    build_chosen,
    choose_scenario,
    output_folder,
    scenario_parser,
    versions,
)
from kitting_drake.scenario.policies import seeds_learned_from, source_of
from kitting_drake.scenario.schema import Learned, PythonPolicy, ToolsetKitting


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

    policy = chosen.scenario.policy
    if isinstance(policy, Learned):
        known = seeds_learned_from(policy, base=chosen.base).intersection(seeds)
        if known:
            console.print(f"note: the policy has learned from seeds {min(known)} to {max(known)}")
    # What cannot be built at all is told at once, not once for each seed.
    build_chosen(chosen, seed=seeds[0])
    start = time.perf_counter()
    with alone_in(folder):
        episodes = evaluate(chosen, seeds, folder, workers=arguments.workers, console=console)
        summary = summarise(episodes, chosen, wall_seconds_total=time.perf_counter() - start)
        write_json(folder / "summary.json", summary)
        draw_summary(summary, episodes, folder / "summary.png")
    console.print(summary_table(summary))
    console.print(summary_notes(summary), highlight=False)
    console.print(f"files: {folder}/", highlight=False)
    failed = [episode for episode in episodes if episode["failure"]]
    if failed:
        first = failed[0]
        console.print(f"failed first: seed {first['seed']}: {first['failure']}", highlight=False)
    return FAILED if len(failed) == len(episodes) else 0


def evaluate(
    chosen: ChosenScenario, seeds: Iterable[int], folder: Path, *, workers: int, console: Console
) -> list[Episode]:
    """Runs an episode for each seed, each in a process of its own.

    Episodes already in `folder/episodes.jsonl` are not run again; one is written there as it ends.
    A process that dies leaves a failed episode with its reason; one that something else killed is
    given a second chance.

    Args:
        chosen: the scenario.
        seeds: one episode each.
        folder: where `episodes.jsonl` is; must not hold those of anything else.
        workers: how many run at a time.
        console: for the progress bar.

    Returns:
        The episodes, in the order of the seeds.

    Raises:
        UserError: the folder holds the episodes of another scenario, or of the same with another
            policy, other tools or other versions; or a process was killed twice.
    """
    seeds = list(seeds)
    path = folder / "episodes.jsonl"
    claim_folder(folder, "scenario.json", _identity(chosen), of="scenario, policy or version")
    done = {episode["seed"]: episode for episode in read_lines(path)}
    pending = [seed for seed in seeds if seed not in done]
    queue = iter(pending)
    with counting_bar(console, "episodes") as progress:
        task = progress.add_task("", total=len(seeds), completed=len(seeds) - len(pending))
        for episode in side_by_side(
            lambda seed: _run_apart(chosen, seed), lambda: next(queue, None), workers=workers
        ):
            done[episode["seed"]] = episode
            append_line(path, episode)
            progress.advance(task)
    return [done[seed] for seed in seeds]


def _identity(chosen: ChosenScenario) -> dict[str, Any]:
    """What tells one evaluation from another: files by what they are, not by where they lie."""
    identity = {**copy.deepcopy(chosen.described), "versions": versions()}
    policy, task = chosen.scenario.policy, chosen.scenario.task
    if isinstance(policy, Learned):
        identity["policy"]["weights"] = _digest([chosen.base / policy.weights])
    if isinstance(policy, PythonPolicy):
        identity["policy"]["source"] = _digest([source_of(policy)])
    if not isinstance(task, ToolsetKitting):
        folders = [load_tool(name, chosen.base).directory for name in task.tools]
        identity["tools"] = [
            _digest(sorted(path for path in folder.iterdir() if path.is_file()))
            for folder in folders
        ]
    return identity


def _digest(paths: Iterable[Path]) -> str:
    """Of the content of files."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return f"sha256 {digest.hexdigest()}"


def _run_apart(chosen: ChosenScenario, seed: int) -> Episode:
    """Runs one episode in a fresh process and waits for it."""
    start = time.perf_counter()
    outcome = run_apart(_work, chosen, seed)
    if isinstance(outcome, Died) and outcome.was_killed:
        outcome = run_apart(_work, chosen, seed)
        if isinstance(outcome, Died) and outcome.was_killed:
            raise outcome.killed_twice(seed)
    if isinstance(outcome, Died):
        outcome = f"the process of the episode ended with exit code {outcome.exit_code}"
    if isinstance(outcome, str):
        return _lost_episode(chosen, seed, outcome, time.perf_counter() - start)
    return outcome


def _work(chosen: ChosenScenario, seed: int) -> Episode | str:
    """An episode, or why there is none."""
    try:
        cell = build_chosen(chosen, seed=seed)
    except UserError as error:
        return str(error)
    result = run_episode(
        cell,
        scenario=chosen.name,
        policy=chosen.policy,
        seed=seed,
        time_limit=chosen.scenario.time_limit,
    )
    return result.as_dict()


def _lost_episode(chosen: ChosenScenario, seed: int, failure: str, seconds: float) -> Episode:
    return {
        "scenario": chosen.name,
        "policy": chosen.policy,
        "seed": seed,
        "objects": [],
        "success_rate": 0.0,
        "actions": 0,
        "missed_grasps": 0,
        "dropped_objects": 0,
        "actions_taken": [],
        "sim_seconds": 0.0,
        "wall_seconds": seconds,
        "point_contact_pairs": 0,
        "failure": failure,
        "timed_out": False,
        "interrupted": False,
    }


if __name__ == "__main__":
    run_verb(main)
