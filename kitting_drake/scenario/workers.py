"""The workers that a command line asks for: processes of this machine, or those of a cluster."""

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
    """Adds the flags that say where to run; one excludes the other."""
    flags = parser.add_mutually_exclusive_group()
    # No default: argparse would not see the conflict when it is given as a value.
    flags.add_argument(
        "--workers", type=count_type, help=f"how many side by side ({os.cpu_count()})"
    )
    flags.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run on the Ray cluster at HOST:PORT; auto: that of this machine",
    )


@contextlib.contextmanager
def open_workers(
    arguments: argparse.Namespace, chosen: ChosenScenario
) -> Iterator[tuple[Workers, ChosenScenario]]:
    """Makes ready the workers that `add_workers_flags`'s flags say.

    Yields:
        The workers, and the scenario with its paths as the workers find them.

    Raises:
        UserError: there is no such cluster, or it cannot take the work.
    """
    if arguments.ray is None:
        # What a person's own function remembers must not travel from episode to episode.
        scenario = chosen.scenario
        reuse = not (scenario.policy.modules() or scenario.task.modules())
        with LocalWorkers(arguments.workers or os.cpu_count() or 1, reuse=reuse) as local:
            yield local, chosen
        return
    with tempfile.TemporaryDirectory() as folder:
        shipment = pack(chosen, Path(folder))
        with RayWorkers(arguments.ray, shipment.runtime_env) as cluster:
            yield cluster, shipment.chosen
