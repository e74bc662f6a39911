"""Fixtures for all tests."""

import ctypes
import gc
import importlib
import importlib.metadata
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Tests run in parallel. With more threads than processors, torch is ten times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")


# Modules and tests stay in memory, so there is little garbage to find. Looking for it would take
# a third of the time of imports, and more during tests.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    gc.unfreeze()


@pytest.fixture(scope="session", autouse=True)
def cache_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A fresh cache, so that no test uses files of an older version.

    The workers of pytest-xdist share it, as the processes of `evaluate` share the user's cache.
    """
    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "cache"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session")
def rendering() -> None:
    """Skips the test if images cannot be rendered."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        pytest.skip("rendering needs libEGL.so.1 (Debian package libegl1)")


@pytest.fixture(scope="session")
def freed_diagrams() -> None:
    """Skips the test if Drake keeps every Diagram in memory, as 1.51 does."""
    if importlib.metadata.version("drake").startswith("1.51."):
        pytest.skip("Drake 1.51 keeps every Diagram")


@pytest.fixture
def verb(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., subprocess.CompletedProcess[str]]]:
    """Runs `python -m kitting_drake.VERB ARGUMENTS...` in this process, from the root of the tree.

    This is faster than starting a process. The result holds the exit code and the output.
    """

    def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        from kitting_drake.common.command_line import run_command

        package = f"kitting_drake.{name}"
        main = importlib.import_module("kitting_drake.hkd.__main__" if name == "hkd" else package)
        words = [package, *map(str, arguments)]
        capfd.readouterr()
        with monkeypatch.context() as patch, pytest.raises(SystemExit) as left:
            patch.setattr(sys, "argv", words)
            patch.chdir(ROOT)
            run_command(main.main)
        assert isinstance(left.value.code, int)
        return subprocess.CompletedProcess(words, left.value.code, *capfd.readouterr())

    # Commands change the level of Drake's log.
    level = logging.getLogger("drake").level
    yield run
    logging.getLogger("drake").setLevel(level)


@pytest.fixture(scope="session")
def verb_process() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs `python -m kitting_drake.VERB ARGUMENTS...` in a process, from the root of the tree."""

    def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", f"kitting_drake.{name}", *map(str, arguments)]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)

    return run
