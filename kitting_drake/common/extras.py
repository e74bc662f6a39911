"""Imports optional packages, which are extras of the project."""

import importlib
from types import ModuleType

from kitting_drake.common.errors import MachineError

EXTRAS = {
    "camera": (
        "mcap-ros2-support>=0.5",
        "opencv-python-headless>=4.12",
        "openexr>=3.3",
        "rosbags>=0.10,<0.11",
    ),
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
    """Imports a package that may be missing.

    Args:
        package: name of the package.
        modules: submodules of the package to import as well.
        purpose: the command or option that needs the package, for the error message.
        extra: the project's extra that contains the package.

    Raises:
        MachineError: the package is not installed. The message contains the command that installs
            it.
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
