"""The command line of every command on a scenario."""

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario.description import describe
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.perturbations import LEVELS, NAMES
from kitting_drake.scenario.schema import Scenario


def scenario_parser(command: str, description: str) -> argparse.ArgumentParser:
    """A parser with the flags that every command on a scenario takes."""
    parser = argparse.ArgumentParser(
        prog=f"python -m kitting_drake.{command}", description=description
    )
    add_scenario_flags(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="where all files go (default: output/ and the scenario's name)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def add_scenario_flags(parser: argparse.ArgumentParser) -> None:
    """Adds the flags that say which scenario."""
    parser.add_argument("scenario", type=Path, metavar="SCENARIO.yaml", help="the scenario's file")
    parser.add_argument(
        "--scenario_name", metavar="NAME", help="which scenario of the file (default: the first)"
    )
    parser.add_argument(
        "--scenario_text", metavar="YAML", help="fields merged over the scenario's own"
    )
    parser.add_argument(
        "--perturb",
        metavar="NAME[:LEVEL],...",
        help=f"make the world less perfect: {', '.join(NAMES)}; {', '.join(LEVELS)} (moderate)",
    )


@dataclasses.dataclass(frozen=True)
class ChosenScenario:
    """A scenario as the command line names it."""

    scenario: Scenario
    path: Path
    name: str
    """The name of its file, without the ending, and of the scenario in it if one was given."""
    text: str | None
    """The YAML that was merged over it."""
    perturbed: str | None = None
    """The perturbations that it has, as `--perturb` names them."""
    moved_to: Path | None = None
    """Where relative paths in the scenario start, if not in the folder of its file."""

    @property
    def base(self) -> Path:
        """Where relative paths in the scenario start."""
        return (self.moved_to or self.path.resolve().parent).resolve()

    @contextlib.contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """Puts the file's name before the text of any UserError that is raised within."""
        try:
            yield
        except UserError as error:
            raise type(error)(f"{self.path}: {error}") from error

    @property
    def policy(self) -> str:
        """The policy's name for results."""
        return self.scenario.policy.name

    @property
    def described(self) -> dict[str, Any]:
        """The whole scenario, defaults included, as JSON holds it; variants have a `_tag`."""
        return describe(self.scenario)


def choose_scenario(arguments: argparse.Namespace) -> ChosenScenario:
    """Loads what `scenario_parser`'s flags say.

    Raises:
        UserError: it cannot be used.
    """
    return find_scenario(
        arguments.scenario,
        arguments.scenario_name,
        arguments.scenario_text,
        arguments.perturb,
    )


def find_scenario(
    path: Path, name: str | None = None, text: str | None = None, perturb: str | None = None
) -> ChosenScenario:
    """Loads a scenario as the command line does; the arguments are those of `load_scenario`.

    Raises:
        UserError: it cannot be used.
    """
    if not path.exists() and not path.is_absolute() and ".." not in path.parts:
        # An installed wheel carries its scenarios; `scenarios/x.yaml` means them anywhere.
        inside = path.relative_to(SCENARIOS.name) if path.parts[0] == SCENARIOS.name else path
        path = SCENARIOS / inside if (SCENARIOS / inside).is_file() else path
    scenario = load_scenario(path, name, text, perturb)
    label = path.stem if name is None else f"{path.stem}:{name}"
    return ChosenScenario(scenario, path, label, text, perturb)


def output_folder(arguments: argparse.Namespace, name: str) -> Path:
    """The folder that `--output` names, or the command's own."""
    return arguments.output or Path("output") / name.replace(":", "-")
