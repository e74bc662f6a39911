"""Packages that only some commands need, and that are installed as extras of the project."""

import importlib
from types import ModuleType

from kitting_drake.common.errors import MachineError

EXTRAS = {
    "cluster": ("ray[client]>=2.50",),
    "fabrication": ("ezdxf>=1.4", "svgelements>=1.9.6"),
    "gym": ("gymnasium>=1.0",),
    "lerobot": ("pyarrow>=21",),
    "log": ("mcap-ros2-support>=0.5",),
    "mujoco": ("mujoco>=3.2,<4",),
    "onnx": ("onnx>=1.17", "onnxruntime>=1.20"),
}
"""The packages of each extra, as in pyproject.toml."""


def import_extra(package: str, *modules: str, purpose: str, extra: str) -> ModuleType:
    """A package that may be missing, with some of its modules imported.

    Args:
        package: its name.
        modules: to import too, by their names inside the package.
        purpose: what needs it, for a person.
        extra: the project's extra that brings it.

    Raises:
        MachineError: it is not installed; says by what command it would be.
    """
    try:
        found = importlib.import_module(package)
        for module in modules:
            importlib.import_module(f"{package}.{module}")
    except ImportError as error:
        packages = " ".join(f"'{requirement}'" for requirement in EXTRAS[extra])
        raise MachineError(
            f"{purpose} needs the package {package}: pip install {packages}"
        ) from error
    return found
