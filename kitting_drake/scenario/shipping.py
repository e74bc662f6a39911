"""Packs a scenario and its files for the workers of a Ray cluster, as a `runtime_env`."""

import dataclasses
import importlib.util
import os
import sysconfig
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import kitting_drake
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.common.provenance import COMMIT_VARIABLE, commit
from kitting_drake.hkd.tools.tool import user_tools
from kitting_drake.scenario.choosing import ChosenScenario

_PACKAGES = ("kitting_drake", "systems")

_FILES = Path("files")
"""The subfolder with links to the scenario's files; the link to the file `/a/b` is `files/a/b`."""


@dataclasses.dataclass(frozen=True)
class Shipment:
    """A packed scenario: the result of `pack`."""

    chosen: ChosenScenario
    """The scenario, with paths relative to the packed folder."""
    runtime_env: dict[str, Any]
    """Ray's `runtime_env`, with the working folder, the user's modules, and environment
    variables."""


def pack(chosen: ChosenScenario, folder: Path) -> Shipment:
    """Packs the files that another machine needs to run a scenario.

    These files are the packages and models of this project, the files that task and policy read
    (such as weights or a user's tools), and the modules of a `!PythonPolicy` or `!PythonTask`.
    Other packages must be installed on the other machine. The folder contains links, whose targets
    Ray copies.

    Args:
        chosen: a scenario that can be built here.
        folder: an empty folder for the links. Keep it until Ray has connected.

    Raises:
        UserError: a file does not exist, or a link cannot be made.
    """
    scenario, base = chosen.scenario, chosen.base
    root = Path(kitting_drake.__file__).resolve().parents[1]
    # In an installed wheel, the models lie inside a package and are packed with it.
    shipped = [*_PACKAGES, *([MODELS.name] if MODELS.parent == root else [])]
    try:
        files = {
            path.resolve(strict=True)
            for path in (*scenario.task.input_files(base), *scenario.policy.input_files(base))
        }
        for name in shipped:
            (folder / name).symlink_to(root / name)
        for path in files:
            link = folder / _copy(path)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)
        # A relative path that begins with `..` can be resolved only if this folder exists.
        (folder / _copy(base)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot pack {error.filename}: {error.strerror}") from error
    places = files | {path.parent for path in files}
    moved = dataclasses.replace(
        chosen, scenario=_relative(scenario, base, places), moved_to=_copy(base)
    )
    environment = {
        "OMP_NUM_THREADS": "1",
        "KITTING_DRAKE_TOOLS": str(_copy(user_tools().resolve())),
        COMMIT_VARIABLE: commit() or "",
    }
    runtime_env: dict[str, Any] = {
        "working_dir": str(folder),
        "excludes": ["__pycache__"],
        "env_vars": environment,
    }
    # Set the key only if there are modules, because Ray rejects an empty list.
    if modules := _own_modules([*scenario.policy.modules(), *scenario.task.modules()]):
        runtime_env["py_modules"] = [str(path) for path in modules]
    return Shipment(moved, runtime_env)


def _copy(path: Path) -> Path:
    """The path of the link to a file or folder, relative to the packed folder."""
    return _FILES / path.relative_to(path.anchor)


def _own_modules(modules: Iterable[str]) -> list[Path]:
    """Files or package folders of modules that are neither installed nor part of this project."""
    found: list[Path] = []
    for name in sorted({module.partition(".")[0] for module in modules} - set(_PACKAGES)):
        spec = importlib.util.find_spec(name)
        if spec is None:
            continue
        # A package without an `__init__.py` may have several folders.
        places = [Path(place) for place in spec.submodule_search_locations or [spec.origin or ""]]
        # Packages that are installed here must be installed on the cluster as well, so they are
        # not packed.
        installed = sysconfig.get_path("purelib")
        found += [path for path in places if path.exists() and not path.is_relative_to(installed)]
    return found


def _relative(value: Any, base: Path, places: set[Path]) -> Any:
    """Copies a value and makes every path to one of `places` relative to `base`.

    Absolute paths would not be valid on other machines.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            item.name: _relative(getattr(value, item.name), base, places)
            for item in dataclasses.fields(value)
            if item.init
        }
        return dataclasses.replace(value, **fields)
    if isinstance(value, dict):
        return {
            _relative(key, base, places): _relative(item, base, places)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return type(value)(_relative(item, base, places) for item in value)
    if isinstance(value, str) and value and (place := (base / value).resolve()) in places:
        return os.path.relpath(place, base)
    return value
