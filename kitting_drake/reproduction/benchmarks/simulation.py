"""Measures the wall time of episodes by phase, of starting up, and of rendering images (`benchmark
simulation`)."""

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
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.common.provenance import versions
from kitting_drake.common.rendering import require_rendering
from kitting_drake.episode import EpisodeResult, ModeChange, run_episode
from kitting_drake.evaluation.quantities import numbers_table, ratio_text
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station import build_station, with_policy

_SCENARIO = SCENARIOS / "kitting_oracle.yaml"
_LEARNED = SCENARIOS / "paper/kitting_seen.yaml"


def benchmark_simulation(episodes: int, seed: int, console: Console) -> dict[str, Any]:
    """Runs all measurements of `benchmark simulation`.

    Args:
        episodes: the number of episodes for each of two policies, the oracle and a learned policy.
        seed: the first of the successive seeds.
        console: the console for the progress.
    """
    # Limit PyTorch to one thread before it is loaded, as for each worker of `evaluate`.
    os.environ["OMP_NUM_THREADS"] = "1"
    stopwatch = PhaseStopwatch()
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "drake": versions()["drake"],
        "episodes": episodes,
        "policies": {
            "oracle": _whole_episodes(_SCENARIO, episodes, seed, stopwatch, console),
            "learned": _whole_episodes(_LEARNED, episodes, seed, PhaseStopwatch(), console),
        },
        "phases": {
            name: {
                "simulated_s": simulated,
                "wall_s": wall,
                "wall_s_per_simulated_s": wall / simulated if simulated else None,
            }
            for name, (simulated, wall) in stopwatch.phases.items()
        },
        "start_up_s": _start_up_times(),
        "images_s": _image_times(load_scenario(_SCENARIO), seed),
    }


def _whole_episodes(
    path: Path, episodes: int, seed: int, stopwatch: "PhaseStopwatch", console: Console
) -> dict[str, Any]:
    """Runs whole episodes. Returns their times per placed object; the time to build stations does
    not count."""
    scenario = load_scenario(path)
    simulated = wall = kitted = 0.0
    for number in track(
        range(episodes), path.stem, console=console, transient=True, disable=console.quiet
    ):
        station = build_station(scenario, seed + number, path.parent)
        diagram = with_policy(station)
        stopwatch.start()
        result = run_episode(
            diagram,
            station,
            scenario=path.stem,
            policy=scenario.policy.name,
            observers=[stopwatch.observe],
        )
        _require_whole(result)
        simulated += result.sim_seconds
        wall += result.wall_seconds
        kitted += sum(item.strict_success for item in result.objects)
    return {
        "objects": int(kitted),
        "wall_s_per_object": wall / kitted if kitted else None,
        "real_time_rate": simulated / wall,
        "objects_per_simulated_hour": 3600 * kitted / simulated,
    }


def _require_whole(result: EpisodeResult) -> None:
    """Raises UserError for an episode that cannot be measured, because it failed or timed out."""
    if result.failure or result.timed_out:
        reason = result.failure or "timed out"
        raise UserError(
            f"{result.scenario}, seed {result.seed}: the episode cannot be measured: {reason}"
        )


class PhaseStopwatch:
    """Sums simulated and wall time over episodes, by the planner's mode."""

    def __init__(self) -> None:
        self.phases: dict[str, tuple[float, float]] = {}
        """The simulated and the wall time of each mode, in s."""
        self._last = (0.0, 0.0)

    def start(self) -> None:
        """Starts the clock of an episode."""
        self._last = (0.0, time.perf_counter())

    def observe(self, event: ModeChange) -> None:
        """Adds the time since the last event to the previous mode. This method is an
        `EpisodeObserver`."""
        now = (event.root_context.get_time(), time.perf_counter())
        name = event.previous.name.lower()
        simulated, wall = self.phases.get(name, (0.0, 0.0))
        self.phases[name] = (simulated + now[0] - self._last[0], wall + now[1] - self._last[1])
        self._last = now


def _start_up_times() -> dict[str, float]:
    """Returns the wall times of short runs from the shell, including Meshcat and files, in s."""
    times = {}
    with tempfile.TemporaryDirectory() as folder:
        # Begin with an empty cache, which the first run fills for the second.
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        command = [sys.executable, "-m", "kitting_drake.run", str(_SCENARIO), "--quiet"]
        command += ["--scenario_text", "{time_limit: 0.1}", "--output", folder]
        for name in ("cache_empty", "cache_filled"):
            start = time.perf_counter()
            subprocess.run(command, env=environment, check=True)
            times[name] = time.perf_counter() - start
    return times


def _image_times(scenario: Scenario, seed: int) -> dict[str, float]:
    """Returns the seconds to render one RGB-D image, and to make the heightmap from all cameras.

    Raises:
        UserError: images cannot be rendered on this machine.
    """
    require_rendering()
    station = build_station(scenario, seed, SCENARIOS)
    context = station.CreateDefaultContext()

    def render() -> None:
        for name in scenario.cameras:
            for port in (f"color_image_{name}", f"depth_image_{name}"):
                station.GetOutputPort(port).Eval(context)

    def project() -> None:
        station.GetOutputPort("observation").Eval(context)

    render_times, project_times = [], []
    for second in range(6):
        # Change the time, which invalidates the rendered images.
        context.SetTime(float(second + 1))
        render_times.append(_timed(render))
        project_times.append(_timed(project))
    # Skip the first image, because it loads the meshes.
    return {
        "rgbd_image": float(np.median(render_times[1:])) / len(scenario.cameras),
        "heightmap": float(np.median(project_times[1:])),
    }


def _timed(function: Callable[[], None]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def simulation_tables(measured: dict[str, Any]) -> list[Table]:
    """Makes tables of the measurements."""
    whole = numbers_table(
        "whole episodes, one thread",
        "policy",
        "objects",
        "wall s per object",
        "real-time rate",
        "objects per simulated hour",
    )
    for name, row in measured["policies"].items():
        whole.add_row(
            name,
            str(row["objects"]),
            ratio_text(row["wall_s_per_object"]),
            f"{row['real_time_rate']:.1f}",
            f"{row['objects_per_simulated_hour']:.0f}",
        )
    headings = ("phase", "simulated s", "wall s", "wall s per simulated s")
    phases = numbers_table("the oracle's episodes by phase", *headings)
    for name, row in measured["phases"].items():
        simulated, wall = (f"{row[key]:.1f}" for key in ("simulated_s", "wall_s"))
        phases.add_row(name, simulated, wall, ratio_text(row["wall_s_per_simulated_s"]))
    once = numbers_table("once", "what", "wall s")
    start, images = measured["start_up_s"], measured["images_s"]
    once.add_row("shell to first steps and out again, cache empty", f"{start['cache_empty']:.2f}")
    once.add_row("the same, everything in the cache", f"{start['cache_filled']:.2f}")
    once.add_row("one RGB-D image", f"{images['rgbd_image']:.3f}")
    once.add_row("heightmap from all cameras' images", f"{images['heightmap']:.3f}")
    return [whole, phases, once]
