"""Opens the workers that the command line asks for: local processes or a Ray cluster."""

import argparse
import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from kitting_drake.common.cluster import RayWorkers
from kitting_drake.common.command_line import count_type
from kitting_drake.common.processes import LocalWorkers, Workers
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.shipping import pack


def add_workers_flags(parser: argparse.ArgumentParser) -> None:
    """Adds the mutually exclusive flags `--workers` and `--ray`."""
    flags = parser.add_mutually_exclusive_group()
    # With a default, argparse would miss a conflict if the given value equals the default.
    flags.add_argument(
        "--workers", type=count_type, help=f"number of parallel processes ({os.cpu_count()})"
    )
    flags.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run on the Ray cluster at HOST:PORT; auto: a cluster on this machine",
    )


@contextlib.contextmanager
def open_workers(
    arguments: argparse.Namespace, chosen: ChosenScenario
) -> Iterator[tuple[Workers, ChosenScenario]]:
    """Opens the workers that the flags of `add_workers_flags` select.

    Yields:
        The workers, and the scenario with paths that are valid for the workers.

    Raises:
        UserError: the cluster cannot be reached or cannot run the work.
    """
    if arguments.ray is None:
        # A user's function may keep state, which must not be carried over between episodes, so use
        # a new process for each.
        scenario = chosen.scenario
        reuse = not (scenario.policy.modules() or scenario.task.modules())
        with LocalWorkers(arguments.workers or os.cpu_count() or 1, reuse=reuse) as local:
            yield local, chosen
        return
    with tempfile.TemporaryDirectory() as folder:
        shipment = pack(chosen, Path(folder))
        with RayWorkers(arguments.ray, shipment.runtime_env) as cluster:
            yield cluster, shipment.chosen
