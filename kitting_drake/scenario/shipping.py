"""A scenario and all that it takes to run it, in one archive for other machines."""

import dataclasses
import importlib.util
import os
import sysconfig
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kitting_drake
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.tools.tool import user_tools
from kitting_drake.scenario.choosing import ChosenScenario

_PACKAGES = ("kitting_drake", "systems")

_FILES = Path("files")
"""In the archive: copies of the scenario's files, each at its path on this machine."""


@dataclasses.dataclass(frozen=True)
class Shipment:
    """The result of `pack`."""

    chosen: ChosenScenario
    """The scenario for a process that runs in the folder where the archive was unpacked."""
    environment: dict[str, str]
    """The environment variables that the process needs."""


def pack(chosen: ChosenScenario, archive: Path) -> Shipment:
    """Writes the archive that another machine needs to run a scenario.

    It holds this checkout's or wheel's packages and models, the files that task and policy read
    (weights, tools of one's own), and the module or package of a `!PythonPolicy`. Unpacked, it is
    the folder to run in and to import from; other packages have to be installed there.

    Args:
        chosen: the scenario; it can be built here.
        archive: the .zip file to write.

    Raises:
        UserError: a file cannot be found or read.
    """
    scenario, base = chosen.scenario, chosen.base
    files = {
        path.resolve()
        for path in (*scenario.task.input_files(base), *scenario.policy.input_files(base))
    }
    try:
        with zipfile.ZipFile(
            archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False
        ) as file:
            for path, name in _sources(scenario.policy.modules()):
                file.write(path, name)
            for path in sorted(files):
                file.write(path, _copy(path))
            # A path that begins with `..` needs the folder, empty or not.
            file.mkdir(str(_copy(base)))
    except OSError as error:
        raise UserError(f"cannot pack {error.filename}: {error.strerror}") from error
    places = files | {path.parent for path in files}
    moved = dataclasses.replace(
        chosen, scenario=_relative(scenario, base, places), moved_to=_copy(base)
    )
    return Shipment(moved, {"KITTING_DRAKE_TOOLS": str(_copy(user_tools().resolve()))})


def _copy(path: Path) -> Path:
    """Where the copy of a file or folder is in the archive."""
    return _FILES / path.relative_to(path.anchor)


def _sources(modules: list[str]) -> Iterator[tuple[Path, Path]]:
    """Files of this project and of a person's own modules, and their names in the archive."""
    root = Path(kitting_drake.__file__).resolve().parents[1]
    folders = [root / name for name in _PACKAGES]
    if MODELS.parent == root:
        # A wheel carries its models inside the package.
        folders.append(MODELS)
    for name in {module.partition(".")[0] for module in modules} - set(_PACKAGES):
        spec = importlib.util.find_spec(name)
        if spec is None:
            continue
        # A package without an `__init__.py` has folders and no origin.
        places = [Path(place) for place in spec.submodule_search_locations or ()]
        if spec.origin is not None:
            places = places or [Path(spec.origin)]
        for place in places:
            if place.is_relative_to(sysconfig.get_path("purelib")):
                # Installed: it has to be there, too.
                continue
            if place.is_dir():
                folders.append(place)
            else:
                yield place, Path(place.name)
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                yield path, path.relative_to(folder.parent)


def _relative(value: Any, base: Path, places: set[Path]) -> Any:
    """A value with every text that names one of `places` made relative to `base`: what is absolute
    here is elsewhere there, and what is a symbolic link here is none there."""
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
