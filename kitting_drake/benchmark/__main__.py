"""`python -m kitting_drake.benchmark simulation | networks | kits`: what things cost here."""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Context
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kitting_drake.cell.cameras import require_rendering
from kitting_drake.cell.cell import Cell, build_cell
from kitting_drake.common.command_line import count_type, run_verb, seed_type
from kitting_drake.common.files import require_folder, write_json
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.episode.episode import run_episode
from kitting_drake.hkd.kits.clearance import measure_clearance
from kitting_drake.hkd.kits.kit import KitParameters, build_block, contact_surface, kit_cavities
from kitting_drake.hkd.tools.tool import load_tool
from kitting_drake.hkd.tools.toolsets import SPLITS, toolsets
from kitting_drake.scenario.schema import Scenario, load_scenario
from systems.pick_place_planner import Mode

_SCENARIO = SCENARIOS / "kitting_oracle.yaml"


def main() -> int:
    """Parses the command line and measures; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.benchmark", description="Measure; print and keep tables."
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    simulation = verbs.add_parser("simulation", help="phases of an episode, start-up, images")
    simulation.add_argument("--episodes", type=count_type, default=3, help="how many to run (3)")
    simulation.add_argument("--seed", type=seed_type, default=0, help="of the first (0)")
    networks = verbs.add_parser(
        "networks", help="parameters and time of the policies' networks, and how fast they could be"
    )
    networks.add_argument("--preset", default="small", help="size of the networks (small)")
    networks.add_argument(
        "--demos",
        type=Path,
        metavar="FILE.h5",
        help="demonstrations, of whose first observation to decide (default: one is drawn)",
    )
    networks.add_argument(
        "--repeats", type=count_type, default=9, help="runs of which the median is taken (9)"
    )
    kits = verbs.add_parser("kits", help="building time, clearance and size of the dataset's kits")
    kits.add_argument("--kits", type=count_type, help="how many of each split (default: all)")
    for verb in (simulation, networks, kits):
        verb.add_argument(
            "--output", type=Path, default=Path("output/benchmark"), help="where the files go"
        )
        verb.add_argument("--quiet", action="store_true", help="print nothing but errors")
    arguments = parser.parse_args()
    console = Console(quiet=arguments.quiet)
    folder = require_folder(arguments.output)
    if arguments.verb == "networks":
        measured, tables = _networks(arguments, console)
    else:
        # One core, as claimed; children inherit it.
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        if arguments.verb == "simulation":
            measured = benchmark_simulation(arguments.episodes, arguments.seed, console)
            tables = simulation_tables(measured)
        else:
            measured = benchmark_kits(arguments.kits, console)
            tables = [kits_table(measured)]
    write_json(folder / f"{arguments.verb}.json", measured)
    if arguments.verb == "networks":
        # Not before the figures are safe, and not where nobody needs torch.
        from kitting_drake.benchmark.networks.figure import draw_networks

        draw_networks(measured, folder / "networks.png")
    for table in tables:
        console.print(table)
    console.print(f"files: {folder}/", highlight=False)
    return 0


def _networks(
    arguments: argparse.Namespace, console: Console
) -> tuple[dict[str, Any], list[Table]]:
    """Measures the networks."""
    # Imported here: the other verbs need no torch.
    from kitting_drake.benchmark.networks import benchmark_networks
    from kitting_drake.benchmark.networks.bench import Plan
    from kitting_drake.benchmark.networks.tables import network_tables

    plan = Plan(preset=arguments.preset, repeats=arguments.repeats, demonstrations=arguments.demos)
    measured = benchmark_networks(plan, console)
    return measured, network_tables(measured)


def benchmark_simulation(episodes: int, seed: int, console: Console) -> dict[str, Any]:
    """Measures everything that `benchmark simulation` shows, in seconds of wall time.

    Args:
        episodes: how many whole episodes of the oracle to run.
        seed: of the first; the others follow.
        console: for progress.
    """
    scenario = load_scenario(_SCENARIO)
    stopwatch = _PhaseWatch()
    simulated = wall = 0.0
    for number in track(
        range(episodes), "episodes", console=console, transient=True, disable=console.quiet
    ):
        stopwatch.restart()
        result = run_episode(
            _build(scenario, seed + number),
            scenario=_SCENARIO.stem,
            policy="oracle",
            seed=seed + number,
            time_limit=scenario.time_limit,
            watch=stopwatch.look,
        )
        simulated += result.sim_seconds
        wall += result.wall_seconds
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, one used",
        "python": platform.python_version(),
        "episodes": episodes,
        "real_time_rate": simulated / wall,
        "phases": {
            name: {
                "simulated_s": phase_simulated,
                "wall_s": phase_wall,
                "wall_s_per_simulated_s": phase_wall / phase_simulated,
            }
            for name, (phase_simulated, phase_wall) in stopwatch.phases.items()
        },
        "start_up_s": _start_up_times(),
        "images_s": _image_times(scenario, seed),
    }


def _build(scenario: Scenario, seed: int) -> Cell:
    return build_cell(scenario, seed=seed, base=SCENARIOS)


class _PhaseWatch:
    """Sums simulated and wall time by the planner's mode."""

    def __init__(self) -> None:
        self.phases: dict[str, tuple[float, float]] = {}
        self._last: tuple[float, float] | None = None

    def restart(self) -> None:
        """Forgets when the last step was: another episode begins."""
        self._last = None

    def look(self, root_context: Context, mode: Mode) -> None:
        """Adds the time since the last step to the mode's."""
        now = (root_context.get_time(), time.perf_counter())
        if self._last is not None:
            name = mode.name.lower()
            simulated, wall = self.phases.get(name, (0.0, 0.0))
            self.phases[name] = (simulated + now[0] - self._last[0], wall + now[1] - self._last[1])
        self._last = now


def _start_up_times() -> dict[str, float]:
    """From the shell to the end of a run of a few steps, its Meshcat and files included."""
    times = {}
    with tempfile.TemporaryDirectory() as folder:
        # The first run finds no kit in the cache, the second does.
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        command = [sys.executable, "-m", "kitting_drake.run", str(_SCENARIO), "--quiet"]
        command += ["--scenario_text", "{time_limit: 0.1}", "--output", folder]
        for name in ("kit_to_build", "kit_cached"):
            start = time.perf_counter()
            subprocess.run(command, env=environment, check=True)
            times[name] = time.perf_counter() - start
    return times


def _image_times(scenario: Scenario, seed: int) -> dict[str, float]:
    """Of one RGB-D image, and of the heightmap from all cameras' images once they are there.

    Raises:
        UserError: images cannot be rendered here.
    """
    require_rendering()
    cell = _build(scenario, seed)
    context = cell.diagram.CreateDefaultContext()
    sensors = [cell.diagram.GetSubsystemByName(f"camera_{name}") for name in scenario.cameras]
    projector = cell.diagram.GetSubsystemByName("heightmap_projector")

    def render() -> None:
        for sensor in sensors:
            for port in ("color_image", "depth_image_32f"):
                sensor.GetOutputPort(port).Eval(sensor.GetMyContextFromRoot(context))

    def project() -> None:
        projector.get_output_port().Eval(projector.GetMyContextFromRoot(context))

    render_times, project_times = [], []
    for second in range(6):
        # Images depend on time, so that what was rendered before is stale.
        context.SetTime(float(second + 1))
        render_times.append(_timed(render))
        project_times.append(_timed(project))
    # The first one loads meshes into the engine.
    return {
        "rgbd_image": float(np.median(render_times[1:])) / len(sensors),
        "heightmap": float(np.median(project_times[1:])),
    }


def _timed(function: Callable[[], None]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def benchmark_kits(count: int | None, console: Console) -> dict[str, Any]:
    """Builds the dataset's kits anew and measures them; times in seconds, lengths in millimetres.

    Args:
        count: how many of each split, or all when None.
        console: for progress.
    """
    parameters = KitParameters()
    build_times, triangles, medians, minima = [], [], [], []
    chosen = [names for split in SPLITS for names in toolsets(split)[:count]]
    for names in track(chosen, "kits", console=console, transient=True, disable=console.quiet):
        start = time.perf_counter()
        # From the meshes on disk to the block, with nothing remembered.
        tools = [load_tool(name) for name in names]
        cavities = kit_cavities(tools, parameters)
        block = build_block(cavities, parameters)
        _, faces = contact_surface(cavities, parameters)
        build_times.append(time.perf_counter() - start)
        triangles.append(len(faces))
        for tool in tools:
            clearance = measure_clearance(block, tool, parameters)
            medians.append(1e3 * clearance.median)
            minima.append(1e3 * clearance.minimum)
    return {
        "kits": len(chosen),
        "build_s": {"median": float(np.median(build_times)), "max": max(build_times)},
        "contact_triangles": {"median": float(np.median(triangles)), "max": max(triangles)},
        "clearance_mm": {
            "smallest_median": min(medians),
            "median": float(np.median(medians)),
            "largest_median": max(medians),
            "minimum": min(minima),
        },
    }


def kits_table(measured: dict[str, Any]) -> Table:
    """For the terminal."""
    table = Table(title=f"{measured['kits']} kits, one core", title_justify="left")
    table.add_column("what")
    table.add_column("measured", justify="right")
    build, triangles = measured["build_s"], measured["contact_triangles"]
    clearance = measured["clearance_mm"]
    table.add_row("building, s: median, slowest", f"{build['median']:.2f}, {build['max']:.2f}")
    table.add_row(
        "triangles for the contact solver: median, most",
        f"{triangles['median']:.0f}, {triangles['max']}",
    )
    table.add_row(
        "clearance, mm: median along an outline, over all cavities",
        f"{clearance['smallest_median']:.2f} to {clearance['largest_median']:.2f}",
    )
    table.add_row("clearance, mm: least anywhere", f"{clearance['minimum']:.2f}")
    return table


def simulation_tables(measured: dict[str, Any]) -> list[Table]:
    """For the terminal."""
    phases = Table(
        title=f"whole episodes: {measured['real_time_rate']:.2f} times real time on one core",
        title_justify="left",
    )
    phases.add_column("phase")
    for heading in ("simulated s", "wall s", "wall s per simulated s"):
        phases.add_column(heading, justify="right")
    for name, row in measured["phases"].items():
        phases.add_row(
            name,
            f"{row['simulated_s']:.1f}",
            f"{row['wall_s']:.1f}",
            f"{row['wall_s_per_simulated_s']:.2f}",
        )
    once = Table(title="once", title_justify="left")
    once.add_column("what")
    once.add_column("wall s", justify="right")
    start, images = measured["start_up_s"], measured["images_s"]
    once.add_row("shell to first steps and out again, kit to build", f"{start['kit_to_build']:.2f}")
    once.add_row("the same, kit in the cache", f"{start['kit_cached']:.2f}")
    once.add_row("one RGB-D image", f"{images['rgbd_image']:.3f}")
    once.add_row("heightmap from three images", f"{images['heightmap']:.3f}")
    return [phases, once]


if __name__ == "__main__":
    run_verb(main)
