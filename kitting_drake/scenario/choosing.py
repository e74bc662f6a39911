"""The command-line flags shared by all commands that take a scenario."""

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import files_digest
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.common.provenance import versions
from kitting_drake.scenario.description import describe
from kitting_drake.scenario.loader import load_scenario, scenario_names
from kitting_drake.scenario.perturbations import LEVELS, NAMES
from kitting_drake.scenario.schema import Scenario


def scenario_parser(command: str, description: str) -> argparse.ArgumentParser:
    """A parser with the flags of every command that takes a scenario."""
    parser = argparse.ArgumentParser(
        prog=f"python -m kitting_drake.{command}", description=description
    )
    add_scenario_flags(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for all files without a path of their own (default: a subfolder of output/, "
        "named after the scenario)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def add_scenario_flags(parser: argparse.ArgumentParser) -> None:
    """Adds the flags that select a scenario."""
    parser.add_argument("scenario", type=Path, metavar="SCENARIO.yaml", help="the scenario's file")
    parser.add_argument(
        "--scenario_name",
        metavar="NAME",
        help="which scenario in the file (default: the first)",
    )
    parser.add_argument(
        "--scenario_text", metavar="YAML", help="fields that override those of the scenario"
    )
    parser.add_argument(
        "--perturb",
        metavar="NAME[:LEVEL],...",
        help=f"add imperfections: {', '.join(NAMES)}; levels: {', '.join(LEVELS)} (moderate)",
    )


@dataclasses.dataclass(frozen=True)
class ChosenScenario:
    """A scenario with the command-line arguments that selected it."""

    scenario: Scenario
    path: Path
    name: str
    """The file's name without its suffix. `:NAME` follows if the command line selected one of the
    file's scenarios by name."""
    text: str | None
    """The YAML that is merged over the scenario."""
    perturbed: str | None = None
    """The scenario's perturbations, in the syntax of `--perturb`."""
    moved_to: Path | None = None
    """The base folder of relative paths in the scenario; None if it is the folder of the scenario's
    file."""

    @property
    def base(self) -> Path:
        """The base folder of relative paths in the scenario."""
        return (self.moved_to or self.path.resolve().parent).resolve()

    @contextlib.contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """Puts the name of the scenario's file before the message of a UserError raised inside."""
        try:
            yield
        except UserError as error:
            raise type(error)(f"{self.path}: {error}") from error

    @property
    def policy(self) -> str:
        """The policy's name in results."""
        return self.scenario.policy.name

    @property
    def described(self) -> dict[str, Any]:
        """The whole scenario with its defaults, as JSON values. The key `_tag` names the type of a
        field with several types."""
        return describe(self.scenario)

    def identity(self) -> dict[str, Any]:
        """The scenario, the versions of the software, and digests of the scenario's input files.

        Episodes depend on these values, so a run can be resumed only if they are equal.
        """
        scenario = self.scenario
        return {
            **self.described,
            "versions": versions(),
            "policy_digest": scenario.policy.digest(self.base),
            # The floating-point type depends on the machine, and results depend on the type.
            "compute_type": scenario.policy.details(self.base).get("compute_type"),
            "task_digest": files_digest(scenario.task.input_files(self.base)),
        }


def choose_scenario(arguments: argparse.Namespace) -> ChosenScenario:
    """Loads the scenario that the flags of `scenario_parser` select. If the file has several and
    no name is given, prints the names.

    Raises:
        UserError: the file cannot be read, or a field is invalid.
    """
    chosen = find_scenario(
        arguments.scenario,
        arguments.scenario_name,
        arguments.scenario_text,
        arguments.perturb,
    )
    if arguments.scenario_name is None and not arguments.quiet:
        first, *others = scenario_names(chosen.path)
        if others:
            print(
                f"note: this is {first}, the first scenario in {chosen.path}; "
                f"--scenario_name chooses {' or '.join(others)}"
            )
    return chosen


def find_scenario(
    path: Path, name: str | None = None, text: str | None = None, perturb: str | None = None
) -> ChosenScenario:
    """Loads a scenario as the command line does. For the arguments see `load_scenario`.

    Raises:
        UserError: the file cannot be read, or a field is invalid.
    """
    if not path.exists() and not path.is_absolute() and ".." not in path.parts:
        # In any working directory, `scenarios/x.yaml` also finds the scenarios of an installed
        # wheel.
        inside = path.relative_to(SCENARIOS.name) if path.parts[0] == SCENARIOS.name else path
        path = SCENARIOS / inside if (SCENARIOS / inside).is_file() else path
    scenario = load_scenario(path, name, text, perturb)
    label = path.stem if name is None else f"{path.stem}:{name}"
    return ChosenScenario(scenario, path, label, text, perturb)


def output_folder(arguments: argparse.Namespace, name: str) -> Path:
    """The folder given by `--output`; by default `output/NAME`."""
    return arguments.output or Path("output") / name.replace(":", "-")
