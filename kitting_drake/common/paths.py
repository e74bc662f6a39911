"""Where the project's files are, in a checkout or in an installed wheel, and its cache."""

import os
from pathlib import Path


def _data_root() -> Path:
    package = Path(__file__).resolve().parent.parent
    # A wheel carries models/ and scenarios/ inside the package; a checkout has them beside it.
    return package if (package / "models").is_dir() else package.parent


MODELS = _data_root() / "models"
"""Hand, table and tools; also the folder of the ROS package `kitting_models`."""

GENERALIST = MODELS / "policies" / "generalist.safetensors"
"""The weights of the policy for anybody's tools, trained on static scenes."""

SCENARIOS = _data_root() / "scenarios"
"""The scenarios that come with the project."""


def cache_directory() -> Path:
    """The folder for what can be made again: `$XDG_CACHE_HOME/kitting_drake`, or in `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "kitting_drake"
