import importlib.metadata
import subprocess
from pathlib import Path

import pytest

import kitting_drake
from kitting_drake.common.provenance import (
    COMMIT_VARIABLE,
    commit,
    is_reproducible,
    short_commits,
    uncommitted_note,
    versions,
)


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with one file and one commit, from which the package seems to be imported."""
    package = tmp_path / "kitting_drake" / "__init__.py"
    package.parent.mkdir()
    package.write_text("")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    monkeypatch.setattr(kitting_drake, "__file__", str(package))
    return tmp_path


def test_commit_marks_uncommitted_changes(checkout: Path):
    head = git(checkout, "rev-parse", "HEAD")
    assert len(head) == 40
    assert commit() == head
    (checkout / "output.json").write_text("{}")  # An untracked file does not count.
    assert commit() == head
    (checkout / "kitting_drake" / "__init__.py").write_text("changed = True\n")
    assert commit() == f"{head}+"


def test_uncommitted_note(checkout: Path, monkeypatch: pytest.MonkeyPatch):
    assert uncommitted_note() is None
    (checkout / "kitting_drake" / "__init__.py").write_text("changed = True\n")
    assert "uncommitted" in uncommitted_note()
    monkeypatch.setenv("PATH", str(checkout))
    assert uncommitted_note() is None


@pytest.mark.parametrize(
    ("commits", "known", "short"),
    [
        ("0123456789", True, "01234567"),
        ("0123456789+", False, "01234567+"),
        ("0123456789, abcdefghij+", False, "01234567, abcdefgh+"),
        (None, False, "-"),
    ],
)
def test_short_commits_keep_the_mark_of_uncommitted_changes(
    commits: str | None, known: bool, short: str
):
    assert is_reproducible(commits) == known
    assert short_commits(commits) == short


def test_an_installed_package_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(kitting_drake, "__file__", str(tmp_path / "kitting_drake" / "x.py"))
    assert commit() is None


def test_without_git_the_commit_is_none(checkout: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(checkout))
    assert commit() is None


def test_versions_include_the_main_dependencies():
    found = versions()
    assert found.keys() >= {"kitting_drake", "drake", "numpy", "python"}
    assert found["drake"] == importlib.metadata.version("drake")
    assert found["kitting_drake"] == kitting_drake.__version__
    assert all(isinstance(text, str) and text for text in found.values())


def test_copied_sources_take_their_commit_from_the_environment(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(COMMIT_VARIABLE, "f00d+")
    assert commit() == "f00d+"
