"""What the verbs' command lines share."""

import argparse
import dataclasses
import importlib.metadata
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat

import kitting_drake
from kitting_drake.cell.cell import Cell, build_cell
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario.policies import Watch
from kitting_drake.scenario.schema import Scenario, load_scenario


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

    @property
    def described(self) -> dict[str, Any]:
        """The scenario as JSON holds it."""
        return json.loads(json.dumps(dataclasses.asdict(self.scenario), default=str))


def choose_scenario(arguments: argparse.Namespace) -> ChosenScenario:
    """Loads what `scenario_parser`'s flags say.

    Raises:
        UserError: it cannot be used.
    """
    path: Path = arguments.scenario
    by_name = path.parent in (Path(), Path(SCENARIOS.name))
    if by_name and not path.exists() and (SCENARIOS / path.name).is_file():
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
    watch: Watch | None = None,
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
            watch=watch,
        )
    except UserError as error:
        raise UserError(f"{chosen.path}: {error}") from error


def versions() -> dict[str, str]:
    """Of what results depend on: of this package, and of what it stands on."""
    return {
        "kitting_drake": kitting_drake.__version__,
        "drake": importlib.metadata.version("drake"),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def output_folder(arguments: argparse.Namespace, name: str) -> Path:
    """The folder that `--output` names, or the verb's own."""
    return arguments.output or Path("output") / name.replace(":", "-")
