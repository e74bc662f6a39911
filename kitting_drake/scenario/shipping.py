"""A scenario and all that it takes to run it, as a Ray cluster's `runtime_env` carries it."""

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
"""In the folder: links to the scenario's files, each at its path on this machine."""


@dataclasses.dataclass(frozen=True)
class Shipment:
    """The result of `pack`."""

    chosen: ChosenScenario
    """The scenario for a process that runs in the folder's copy."""
    runtime_env: dict[str, Any]
    """Ray's: the folder to run in, a person's own modules, and environment variables."""


def pack(chosen: ChosenScenario, folder: Path) -> Shipment:
    """Gathers what another machine needs to run a scenario, as links; Ray copies what they name.

    It is this checkout's or wheel's packages and models, the files that task and policy read
    (weights, tools of one's own), and the modules or packages of a `!PythonPolicy` and of a
    `!PythonTask`. Other packages have to be installed there.

    Args:
        chosen: the scenario; it can be built here.
        folder: an empty folder for the links; the command needs it until Ray has connected.

    Raises:
        UserError: a file cannot be found, or a link cannot be made.
    """
    scenario, base = chosen.scenario, chosen.base
    root = Path(kitting_drake.__file__).resolve().parents[1]
    # A wheel carries its models inside the package.
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
        # A path that begins with `..` needs the folder, empty or not.
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
    # Ray fails on an empty list.
    if modules := _own_modules([*scenario.policy.modules(), *scenario.task.modules()]):
        runtime_env["py_modules"] = [str(path) for path in modules]
    return Shipment(moved, runtime_env)


def _copy(path: Path) -> Path:
    """Where the link to a file or folder is."""
    return _FILES / path.relative_to(path.anchor)


def _own_modules(modules: Iterable[str]) -> list[Path]:
    """The files, or the packages' folders, of modules that are neither ours nor installed."""
    found: list[Path] = []
    for name in sorted({module.partition(".")[0] for module in modules} - set(_PACKAGES)):
        spec = importlib.util.find_spec(name)
        if spec is None:
            continue
        # A package without an `__init__.py` may have several folders.
        places = [Path(place) for place in spec.submodule_search_locations or [spec.origin or ""]]
        # Installed packages have to be installed on the node, too.
        installed = sysconfig.get_path("purelib")
        found += [path for path in places if path.exists() and not path.is_relative_to(installed)]
    return found


def _relative(value: Any, base: Path, places: set[Path]) -> Any:
    """A value with every text that names one of `places` made relative to `base`.

    An absolute path is another one on the node, and symbolic links are not kept there.
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
