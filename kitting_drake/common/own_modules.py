"""Imports the user's modules that a scenario names: from Python's path, or from the folder of the
scenario's YAML file."""

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kitting_drake.common.provenance import source_digest


@contextlib.contextmanager
def modules_beside(base: Path) -> Iterator[None]:
    """Appends a folder to Python's module path.

    As usual in Python, the first imported module of a name stays.

    Args:
        base: the folder of the scenario's file.
    """
    folder = str(base.resolve())
    if folder in sys.path:
        yield
        return
    importlib.invalidate_caches()
    sys.path.append(folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(folder)


def import_own(reference: str, base: Path) -> Any:
    """Imports `module:name`.

    Args:
        reference: the module and a name in it.
        base: the folder of the scenario's file.

    Raises:
        Exception: whatever the module raises.
    """
    module, _, name = reference.partition(":")
    with modules_beside(base):
        return getattr(importlib.import_module(module), name)


def own_digest(module: str, base: Path) -> str:
    """A digest of the sources of a module's package, or of the module if it is in no package.

    Args:
        module: its name.
        base: the folder of the scenario's file.

    Raises:
        ImportError: the module cannot be imported.
        LookupError: the module has no file.
        OSError: its sources cannot be read.
    """
    with modules_beside(base):
        spec = importlib.util.find_spec(module)
        if spec is None or not spec.has_location:
            raise LookupError(f"there is no file of the module {module}")
        # The module may import the rest of its package.
        package = module.partition(".")[0]
        top = importlib.util.find_spec(package)
        return source_digest(package if top is not None and top.has_location else module)


def files_beside(module: str, base: Path) -> list[Path]:
    """The files of a module, or of its package, in the folder of the scenario's file; empty if it
    is elsewhere.

    Args:
        module: its name.
        base: the folder of the scenario's file.
    """
    top = base / module.partition(".")[0]
    if top.with_suffix(".py").is_file():
        return [top.with_suffix(".py")]
    found = (path for path in top.rglob("*") if "__pycache__" not in path.parts)
    return sorted(path for path in found if path.is_file())
