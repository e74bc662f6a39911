"""Finds the versions and the commit of the code that makes a result."""

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
from pathlib import Path

import numpy as np

import kitting_drake

COMMIT_VARIABLE = "KITTING_DRAKE_COMMIT"
"""Environment variable with the commit of sources that were copied to a cluster without their
history."""


_UNCOMMITTED = "+"
"""Suffix of a commit whose tree had uncommitted changes."""


def versions() -> dict[str, str]:
    """The versions of this package and its main dependencies. Drake is left out if it is not
    installed."""
    found = {"kitting_drake": kitting_drake.__version__}
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        found["drake"] = importlib.metadata.version("drake")
    return found | {"numpy": np.__version__, "python": platform.python_version()}


def commit() -> str | None:
    """The checkout's commit, with the suffix `+` if tracked files have changed.

    On a cluster's node it is the value of `COMMIT_VARIABLE`. For an installed package it is None.
    """
    if given := os.environ.get(COMMIT_VARIABLE):
        return given
    root = Path(kitting_drake.__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    try:
        head = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return None
    return head + (_UNCOMMITTED if changed else "")


def is_reproducible(commits: str | None) -> bool:
    """Whether all code that made a result can be checked out again.

    Args:
        commits: a result of `commit`, or several separated by commas. None or an empty text means
            that the code is unknown.
    """
    return commits is not None and commits != "" and _UNCOMMITTED not in commits


def short_commits(commits: str | None) -> str:
    """Cuts each commit to eight digits, but keeps the mark of uncommitted changes; `-` for None."""
    found = (commits or "-").split(", ")
    return ", ".join(item[:8] + _UNCOMMITTED * item.endswith(_UNCOMMITTED) for item in found)


def uncommitted_note() -> str | None:
    """A warning if the tree has uncommitted changes; else None."""
    now = commit()
    if now is None or is_reproducible(now):
        return None
    return (
        "the tree has uncommitted changes: this run cannot be repeated from its commit, and "
        "`results` will not accept it for the paper's tables"
    )


def source_files(name: str) -> tuple[Path, list[Path]]:
    """The folder and the Python files of a module, or of a package with its submodules.

    Raises:
        ImportError: there is no such package or module.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        raise ImportError(f"there is no package or module {name}")
    root = Path(spec.origin).parent
    is_package = spec.submodule_search_locations is not None
    return root, sorted(root.rglob("*.py")) if is_package else [Path(spec.origin)]


def source_digest(*names: str) -> str:
    """A digest of the Python sources of packages and modules.

    Args:
        names: the packages and modules; a package includes its submodules.
    """
    digest = hashlib.sha256()
    for name in names:
        root, files = source_files(name)
        for path in files:
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()
