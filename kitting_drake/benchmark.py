"""`python -m kitting_drake.benchmark NAME`: measures, prints tables and saves them.

NAME is simulation, networks, kits, recovery, endurance, reliability, reach, mujoco, trace,
traced_kits, fits or paper.
"""

import argparse
import os
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from kitting_drake.common.command_line import FAILED, run_command
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in, require_folder, write_atomically, write_json
from kitting_drake.common.provenance import uncommitted_note
from kitting_drake.reproduction.benchmark_flags import benchmark_parser
from kitting_drake.scenario.choosing import choose_scenario
from kitting_drake.scenario.workers import open_workers


def main() -> int:
    """Parses the command line and runs the benchmark; returns the exit code."""
    arguments = benchmark_parser().parse_args()
    console = Console(quiet=arguments.quiet)
    folder = require_folder(arguments.output)
    if arguments.benchmark == "paper":
        return _paper(arguments, console, folder)
    if arguments.benchmark == "recovery":
        return _recovery(arguments, console, folder)
    if arguments.benchmark == "endurance":
        return _endurance(arguments, console, folder)
    measure = {
        "simulation": _simulation,
        "networks": _networks,
        "kits": _kits,
        "fits": _fits,
        "mujoco": _mujoco,
        "reliability": _reliability,
        "trace": _trace,
        "traced_kits": _traced_kits,
        "reach": _reach,
    }[arguments.benchmark]
    for table in measure(arguments, console, folder):
        console.print(table)
    console.print(f"files: {folder}/", highlight=False, markup=False)
    return 0


# Each benchmark imports its modules lazily, so that only those of NAME are loaded.


def _simulation(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.simulation import (
        benchmark_simulation,
        simulation_tables,
    )

    _use_one_core()
    measured = benchmark_simulation(arguments.episodes, arguments.seed, console)
    write_json(folder / "simulation.json", measured)
    return simulation_tables(measured)


def _kits(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.kits_benchmark import benchmark_kits, kits_table

    _use_one_core()
    measured = benchmark_kits(arguments.kits, console)
    write_json(folder / "kits.json", measured)
    return [kits_table(measured)]


def _fits(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.fits_benchmark import fits_table, measure_fits
    from kitting_drake.reproduction.benchmarks.fits_figure import draw_fits

    with alone_in(folder):
        measured = measure_fits(arguments.episodes, arguments.seed, folder, console)
        write_json(folder / "fits.json", measured)
        write_atomically(folder / "fits.png", draw_fits(measured))
    return [fits_table(measured)]


def _networks(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.network_speed import benchmark_networks
    from kitting_drake.reproduction.network_speed.plan import Plan
    from kitting_drake.reproduction.network_speed.speed_tables import network_tables

    plan = Plan(preset=arguments.preset, repeats=arguments.repeats, demonstrations=arguments.demos)
    measured: dict[str, Any] = benchmark_networks(plan, console)
    write_json(folder / "networks.json", measured)
    # Import matplotlib only after the results are saved.
    from kitting_drake.reproduction.network_speed.speed_figure import draw_networks

    draw_networks(measured, folder / "networks.png")
    return network_tables(measured)


def _recovery(arguments: argparse.Namespace, console: Console, folder: Path) -> int:
    """Measures the recovery from failed actions; returns the exit code."""
    from kitting_drake.reproduction.benchmarks.recovery_benchmark import (
        benchmark_recovery,
        recovery_table,
    )

    chosen = choose_scenario(arguments)
    measured, strips = benchmark_recovery(chosen, arguments.episodes, arguments.seed, console)
    measured |= {"scenario": chosen.name, "perturbed": chosen.perturbed, "text": chosen.text}
    write_json(folder / "recovery.json", measured)
    if strips:
        write_atomically(folder / "recovery.png", strips)
    console.print(recovery_table(measured))
    console.print(f"files: {folder}/", highlight=False, markup=False)
    counts = measured["disturbances"].values()
    return FAILED if all(count["failed"] == arguments.episodes for count in counts) else 0


def _reach(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.real_camera import BenchRobot, read_calibration, read_robot
    from kitting_drake.reproduction.benchmarks.reach import draw_reach, measure_reach, reach_table
    from kitting_drake.scenario.robots import FrankaArm
    from systems.signals import PixelGrid

    arm, grid = FrankaArm(), PixelGrid()
    robot = BenchRobot(arm.model, arm.arm_base())
    if arguments.robot is not None:
        robot = read_robot(arguments.robot)
    if arguments.camera is not None:
        grid = read_calibration(arguments.camera, poses=False).grid
    measured = measure_reach(robot, grid, console)
    write_json(folder / "reach.json", measured)
    write_atomically(folder / "reach.png", draw_reach(measured))
    return [reach_table(measured)]


def _endurance(arguments: argparse.Namespace, console: Console, folder: Path) -> int:
    """Runs a simulated work shift; returns the exit code."""
    from kitting_drake.episode.chosen import build_any_chosen
    from kitting_drake.reproduction.benchmarks.shift.endurance import run_shift, summarise_shift
    from kitting_drake.reproduction.benchmarks.shift.endurance_report import (
        draw_endurance,
        endurance_table,
    )

    chosen = choose_scenario(arguments)
    seed = chosen.scenario.random_seed if arguments.seed is None else arguments.seed
    if arguments.hours == 0.0:
        raise UserError("--hours is 0: give a positive number")
    if note := uncommitted_note():
        console.print(f"note: {note}", highlight=False, markup=False)
    # Fail before the shift starts if no scene can be built.
    build_any_chosen(chosen, range(seed, seed + 5))
    with alone_in(folder), open_workers(arguments, chosen) as (workers, sent):
        scenes = run_shift(
            chosen,
            arguments.hours,
            arguments.exchange,
            seed,
            folder,
            workers=workers,
            sent=sent,
            console=console,
        )
        measured = summarise_shift(scenes, chosen, arguments.exchange)
        write_json(folder / "endurance.json", measured)
        write_atomically(folder / "endurance.png", draw_endurance(measured, scenes))
    console.print(endurance_table(measured))
    console.print(f"files: {folder}/", highlight=False, markup=False)
    return FAILED if measured["failed_scenes"] == measured["scenes"] else 0


def _reliability(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.reliability import measure_reliability
    from kitting_drake.reproduction.benchmarks.reliability_report import (
        draw_reliability,
        limits_table,
        reliability_table,
    )

    _use_one_core()
    with alone_in(folder):
        measured = measure_reliability(
            arguments.seed, arguments.scenes, arguments.weights, folder, console, fits=arguments.fit
        )
        write_json(folder / "reliability.json", measured)
        write_atomically(folder / "reliability.png", draw_reliability(measured))
    return [reliability_table(measured), limits_table(measured)]


def _trace(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.trace_benchmark import (
        TOOLS,
        benchmark_trace,
        trace_table,
    )

    measured = benchmark_trace(
        arguments.tools or TOOLS,
        console,
        folder / "photos" if arguments.keep else None,
        exif=not arguments.no_exif,
        seed=arguments.seed,
        shots=arguments.photos,
    )
    write_json(folder / "trace.json", measured)
    return [trace_table(measured)]


def _traced_kits(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.traced_kits import (
        measure_traced_kits,
        traced_kits_table,
    )

    with alone_in(folder):
        measured = measure_traced_kits(
            arguments.kits, arguments.seed, arguments.fit, arguments.photos, folder, console
        )
        write_json(folder / "traced_kits.json", measured)
    return [traced_kits_table(measured)]


def _mujoco(arguments: argparse.Namespace, console: Console, folder: Path) -> list[Table]:
    from kitting_drake.reproduction.benchmarks.second_opinion import ask_mujoco, opinion_table

    measured = ask_mujoco(arguments.placements, arguments.seed, arguments.orientations, console)
    write_json(folder / "mujoco.json", measured)
    return [opinion_table(measured)]


def _paper(arguments: argparse.Namespace, console: Console, folder: Path) -> int:
    """Runs the experiments for the cells of docs/results.md that `--cells` names; returns the exit
    code."""
    from kitting_drake.reproduction.paper.paper_tables import choose_cells
    from kitting_drake.reproduction.paper.queue import Queue, run_paper

    cells = choose_cells(arguments.cells)
    results = require_folder(arguments.results)
    queue = Queue(require_folder(folder / "paper"), results, console, arguments.workers)
    failures = run_paper(queue, cells)
    table = Table("cell", "state", title="the paper's experiments")
    for cell in cells:
        table.add_row(cell.name, failures.get(cell.name, "done"))
    console.print(table)
    return FAILED if failures else 0


def _use_one_core() -> None:
    """Restricts this process and its children to one core, because the tables give times on one
    core."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


if __name__ == "__main__":
    run_command(main)
