"""Packages that only some commands need, and that are installed as extras of the project."""

import importlib
from types import ModuleType

from kitting_drake.common.errors import UserError


def import_extra(package: str, *modules: str, purpose: str, extra: str) -> ModuleType:
    """A package that may be missing, with some of its modules imported.

    Args:
        package: its name.
        modules: to import too, by their names inside the package.
        purpose: what needs it, for a person.
        extra: the project's extra that brings it.

    Raises:
        UserError: it is not installed.
    """
    try:
        found = importlib.import_module(package)
        for module in modules:
            importlib.import_module(f"{package}.{module}")
    except ImportError as error:
        raise UserError(
            f"{purpose} needs the package {package}: pip install 'kitting_drake[{extra}]'"
        ) from error
    return found
