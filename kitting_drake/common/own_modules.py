"""Imports the user's modules that a scenario names. They are found on Python's path or in the
folder of the scenario's YAML file."""

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
    """Appends a folder to Python's module path for the duration of a `with` block.

    As usual in Python, a module is not imported if one of the same name was imported before.

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
    """Imports an object that is given as `module:name`.

    Args:
        reference: the module and the name of the object in it, as `module:name`.
        base: the folder of the scenario's file.

    Raises:
        Exception: any exception that the module raises when it is imported.
    """
    module, _, name = reference.partition(":")
    with modules_beside(base):
        return getattr(importlib.import_module(module), name)


def own_digest(module: str, base: Path) -> str:
    """A digest of the sources of a module's package, or of the module itself if it belongs to no
    package.

    Args:
        module: name of the module.
        base: the folder of the scenario's file.

    Raises:
        ImportError: the module cannot be imported.
        LookupError: the module has no file.
        OSError: the module's sources cannot be read.
    """
    with modules_beside(base):
        spec = importlib.util.find_spec(module)
        if spec is None or not spec.has_location:
            raise LookupError(f"there is no file of the module {module}")
        # The module may import other modules of its package, so include the whole package.
        package = module.partition(".")[0]
        top = importlib.util.find_spec(package)
        return source_digest(package if top is not None and top.has_location else module)


def files_beside(module: str, base: Path) -> list[Path]:
    """The files of a module, or of its package, in the folder of the scenario's file; empty if the
    module is elsewhere.

    Args:
        module: name of the module.
        base: the folder of the scenario's file.
    """
    top = base / module.partition(".")[0]
    if top.with_suffix(".py").is_file():
        return [top.with_suffix(".py")]
    found = (path for path in top.rglob("*") if "__pycache__" not in path.parts)
    return sorted(path for path in found if path.is_file())
