"""What the verbs' command lines share."""

import argparse
import dataclasses
import logging
import sys
from collections.abc import Callable
from pathlib import Path

from pydrake.geometry import Meshcat

from kitting_drake.cell import Cell, build_cell
from kitting_drake.errors import UserError
from kitting_drake.paths import SCENARIOS
from kitting_drake.scenario import Scenario, load_scenario

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def scenario_parser(verb: str, description: str) -> argparse.ArgumentParser:
    """A parser with the flags that every verb on a scenario takes."""
    parser = argparse.ArgumentParser(
        prog=f"python -m kitting_drake.{verb}", description=description
    )
    parser.add_argument("scenario", type=Path, metavar="SCENARIO.yaml", help="the scenario's file")
    parser.add_argument(
        "--scenario_name", metavar="NAME", help="which scenario of the file (default: the first)"
    )
    parser.add_argument(
        "--scenario_text", metavar="YAML", help="fields merged over the scenario's own"
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="where all files go (default: output/ and the scenario's name)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def seed_type(text: str) -> int:
    """A seed given on the command line."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if not 0 <= seed < 2**32:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {2**32 - 1}")
    return seed


def count_type(text: str) -> int:
    """A count given on the command line: 1 or more."""
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return count


@dataclasses.dataclass(frozen=True)
class ChosenScenario:
    """A scenario as the command line names it."""

    scenario: Scenario
    path: Path
    name: str
    """Of its file, without the ending, and of the scenario in it if one was named."""
    text: str | None
    """What was merged over it."""

    @property
    def base(self) -> Path:
        """Where relative paths in the scenario start."""
        return self.path.resolve().parent

    @property
    def policy(self) -> str:
        """The policy's name for results."""
        return type(self.scenario.policy).__name__.lower()


def choose_scenario(arguments: argparse.Namespace) -> ChosenScenario:
    """Loads what `scenario_parser`'s flags say.

    Raises:
        UserError: it cannot be used.
    """
    path: Path = arguments.scenario
    if not path.exists() and not path.is_absolute() and (SCENARIOS / path.name).is_file():
        # An installed wheel carries its scenarios; `scenarios/x.yaml` means them anywhere.
        path = SCENARIOS / path.name
    name: str | None = arguments.scenario_name
    scenario = load_scenario(path, name, arguments.scenario_text)
    label = path.stem if name is None else f"{path.stem}:{name}"
    return ChosenScenario(scenario, path, label, arguments.scenario_text)


def build_chosen(
    chosen: ChosenScenario,
    *,
    seed: int,
    meshcat: Meshcat | None = None,
    picture: bool = False,
    video: Path | None = None,
) -> Cell:
    """`build_cell` for a scenario of the command line.

    Raises:
        UserError: as `build_cell`, with the file's name.
    """
    try:
        return build_cell(
            chosen.scenario,
            seed=seed,
            base=chosen.base,
            meshcat=meshcat,
            picture=picture,
            video=video,
        )
    except UserError as error:
        raise UserError(f"{chosen.path}: {error}") from error


def output_folder(arguments: argparse.Namespace, name: str) -> Path:
    """The folder that `--output` names, or the verb's own."""
    return arguments.output or Path("output") / name.replace(":", "-")


def run_verb(main: Callable[[], int]) -> None:
    """Runs a verb and leaves with its exit code; a user's error is told in one sentence."""
    # Drake announces ports and frame names; a verb says itself what a person needs to know.
    logging.getLogger("drake").setLevel(logging.WARNING)
    try:
        code = main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = INTERRUPTED
    sys.exit(code)
