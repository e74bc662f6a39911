"""Paths of the project's files, in a checkout or an installed wheel, and of its cache."""

import os
from pathlib import Path


def _data_root() -> Path:
    package = Path(__file__).resolve().parent.parent
    # In a wheel, models/ and scenarios/ are inside the package; in a checkout they are beside it.
    return package if (package / "models").is_dir() else package.parent


MODELS = _data_root() / "models"
"""The folder of the models of robots, table and tools. It is also the ROS package
`kitting_models`."""

GENERALIST = MODELS / "policies" / "generalist.safetensors"
"""The file with the weights of the policy for arbitrary tools, which was trained on static
scenes."""

SCENARIOS = _data_root() / "scenarios"
"""The folder of the project's scenarios."""


def cache_directory() -> Path:
    """The cache folder: `$XDG_CACHE_HOME/kitting_drake`, by default in `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "kitting_drake"
