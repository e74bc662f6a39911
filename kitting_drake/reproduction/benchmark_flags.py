"""The command line of `python -m kitting_drake.benchmark`."""

import argparse
import math
from pathlib import Path
from typing import Any

from kitting_drake.common.command_line import count_type, seed_type
from kitting_drake.scenario.choosing import add_scenario_flags
from kitting_drake.scenario.workers import add_workers_flags


def benchmark_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.benchmark",
        description="Run a benchmark; print and save its tables.",
    )
    benchmarks = parser.add_subparsers(dest="benchmark", required=True)
    for add in (
        _add_simulation,
        _add_networks,
        _add_kits,
        _add_fits,
        _add_recovery,
        _add_endurance,
        _add_mujoco,
        _add_reliability,
        _add_trace,
        _add_traced_kits,
        _add_reach,
        _add_paper,
    ):
        add(benchmarks)
    for benchmark in benchmarks.choices.values():
        benchmark.add_argument(
            "--output", type=Path, default=Path("output/benchmark"), help="the folder for the files"
        )
        benchmark.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _add_simulation(benchmarks: Any) -> None:
    simulation = benchmarks.add_parser(
        "simulation", help="run times: phases of an episode, start-up, and images"
    )
    simulation.add_argument("--episodes", type=count_type, default=3, help="number of episodes (3)")
    simulation.add_argument(
        "--seed", type=seed_type, default=0, help="seed of the first episode (0)"
    )


def _add_networks(benchmarks: Any) -> None:
    networks = benchmarks.add_parser(
        "networks",
        help="sizes and run times of the networks, with lower bounds of the times",
    )
    networks.add_argument("--preset", default="small", help="size of the networks (small)")
    networks.add_argument(
        "--demos",
        type=Path,
        metavar="FILE.h5",
        help="demonstrations whose first observation is the input (default: a drawn scene)",
    )
    networks.add_argument(
        "--repeats", type=count_type, default=9, help="number of runs; the median is reported (9)"
    )


def _add_kits(benchmarks: Any) -> None:
    kits = benchmarks.add_parser(
        "kits", help="building time, clearance and size of the dataset's kits"
    )
    kits.add_argument("--kits", type=count_type, help="number of kits of each split (default: all)")


def _add_fits(benchmarks: Any) -> None:
    fits = benchmarks.add_parser(
        "fits", help="strict success and peak force by the cavities' clearance; run again to resume"
    )
    fits.add_argument(
        "--episodes", type=count_type, default=5, help="episodes of four tools per condition (5)"
    )
    fits.add_argument("--seed", type=seed_type, default=0, help="seed of the first episode (0)")


def _add_recovery(benchmarks: Any) -> None:
    recovery = benchmarks.add_parser("recovery", help="a policy's recovery from failed actions")
    add_scenario_flags(recovery)
    recovery.add_argument(
        "--episodes", type=count_type, default=10, help="episodes per failure (10)"
    )
    recovery.add_argument("--seed", type=seed_type, default=0, help="seed of the first episode (0)")


def _add_endurance(benchmarks: Any) -> None:
    endurance = benchmarks.add_parser(
        "endurance",
        help="a simulated work shift: units per hour, time between assists, cycle times",
    )
    add_scenario_flags(endurance)
    endurance.add_argument(
        "--hours", type=_duration, default=8.0, help="simulated hours of the shift (8)"
    )
    endurance.add_argument(
        "--exchange",
        type=_duration,
        default=10.0,
        metavar="SECONDS",
        help="simulated time for exchanging the kit and bringing the next tools (10)",
    )
    endurance.add_argument(
        "--seed", type=seed_type, help="seed of the first scene (default: the scenario's)"
    )
    add_workers_flags(endurance)


def _add_mujoco(benchmarks: Any) -> None:
    opinion = benchmarks.add_parser(
        "mujoco", help="compare the resting poses of placed tools in Drake and MuJoCo"
    )
    opinion.add_argument(
        "--placements", type=count_type, default=50, help="number of placements (50)"
    )
    opinion.add_argument("--seed", type=seed_type, default=0, help="seed of the first episode (0)")
    opinion.add_argument(
        "--orientations",
        type=count_type,
        metavar="N",
        help="round the oracle's actions to N orientations",
    )


def _add_reliability(benchmarks: Any) -> None:
    reliability = benchmarks.add_parser(
        "reliability",
        help="whether a decision's confidence is its probability of success; run again to resume",
    )
    reliability.add_argument(
        "--scenes", type=count_type, default=100, help="number of scenes (100)"
    )
    reliability.add_argument(
        "--seed", type=seed_type, default=900_000, help="seed of the first scene (900000)"
    )
    reliability.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="weights of the networks (default: the generalist)",
    )
    reliability.add_argument(
        "--fit",
        action="store_true",
        help="fit the confidence to these decisions: writes confidence.json",
    )


def _add_trace(benchmarks: Any) -> None:
    tracing = benchmarks.add_parser(
        "trace", help="error of the outlines that `hkd trace` finds in rendered photos of tools"
    )
    tracing.add_argument(
        "--tools",
        nargs="+",
        metavar="NAME",
        help="names of the tools; three scenes of each are rendered (default: 20 tools)",
    )
    tracing.add_argument(
        "--no-exif", action="store_true", help="leave the focal length out of the photos"
    )
    tracing.add_argument(
        "--keep", action="store_true", help="keep the photos and pictures in the folder photos"
    )
    tracing.add_argument("--seed", type=int, default=0, help="seed of the photos (default: 0)")
    _add_photos(tracing)


def _add_traced_kits(benchmarks: Any) -> None:
    traced = benchmarks.add_parser(
        "traced_kits",
        help="success of the oracle in kits whose cavities are traced from rendered photos of the "
        "tools; run again to resume",
    )
    traced.add_argument("--kits", type=count_type, default=10, help="number of kits (10)")
    traced.add_argument(
        "--fit", choices=("snug", "easy", "loose"), default="easy", help="the clearance (easy)"
    )
    traced.add_argument("--seed", type=seed_type, default=0, help="seed of photos and scenes (0)")
    _add_photos(traced)


def _add_photos(benchmark: argparse.ArgumentParser) -> None:
    benchmark.add_argument(
        "--photos",
        type=int,
        choices=(1, 2, 3, 4),
        default=1,
        help="number of photos of each scene, from different sides (1)",
    )


def _add_reach(benchmarks: Any) -> None:
    reach = benchmarks.add_parser(
        "reach", help="where an arm reaches in a workspace, and the best place for its base"
    )
    reach.add_argument(
        "--robot",
        type=Path,
        metavar="ROBOT.yaml",
        help="a file with the arm's model and base (default: those of !FrankaArm)",
    )
    reach.add_argument(
        "--camera",
        type=Path,
        metavar="CALIBRATION.yaml",
        help="a calibration whose workspace is used (default: the simulated cell's)",
    )


def _add_paper(benchmarks: Any) -> None:
    paper = benchmarks.add_parser(
        "paper", help="collect, train and evaluate for the cells of the paper's tables; takes days"
    )
    paper.add_argument(
        "--cells",
        nargs="+",
        default=["*"],
        metavar="PATTERN",
        help="names of the cells, in this order (default *: all, the most informative first)",
    )
    paper.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        default=Path("docs/results"),
        help="folder of the table of runs, to which finished cells are added (docs/results)",
    )
    paper.add_argument("--workers", type=count_type, default=1, help="parallel episodes (1)")


def _duration(text: str) -> float:
    """Parses a finite duration of at least 0."""
    try:
        duration = float(text)
    except ValueError:
        duration = -1.0
    if not 0.0 <= duration < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of 0 or more")
    return duration
