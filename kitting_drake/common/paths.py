"""Paths of the project's files, in a checkout or an installed wheel, and of its cache."""

import os
from pathlib import Path


def _data_root() -> Path:
    package = Path(__file__).resolve().parent.parent
    # A wheel contains models/ and scenarios/ in the package; a checkout has them beside it.
    return package if (package / "models").is_dir() else package.parent


MODELS = _data_root() / "models"
"""Models of hand, table and tools; also the folder of the ROS package `kitting_models`."""

GENERALIST = MODELS / "policies" / "generalist.safetensors"
"""Weights of the policy for arbitrary tools, trained on static scenes."""

SCENARIOS = _data_root() / "scenarios"
"""The project's scenarios."""


def cache_directory() -> Path:
    """The cache folder: `$XDG_CACHE_HOME/kitting_drake`, by default in `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "kitting_drake"
