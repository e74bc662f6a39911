"""Files written atomically, in folders of one thing and one process."""

import contextlib
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import MachineError, UserError


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file beside its place and moves it there, making its folder if need be.

    Raises:
        MachineError: the place cannot be written to.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.chmod(scratch, 0o644)
            os.replace(scratch, path)
        except BaseException:
            os.unlink(scratch)
            raise
    except OSError as error:
        raise MachineError(f"cannot write {path}: {error.strerror}") from error


def write_json(path: Path, value: Any) -> None:
    """Writes JSON for people to read; see `write_atomically`."""
    write_atomically(path, json.dumps(value, indent=2) + "\n")


def require_folder(path: Path) -> Path:
    """Makes a folder for a run's files, before the run.

    Raises:
        MachineError: it cannot be made, or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise MachineError(f"cannot write into {path}: {error.strerror}") from error


def replace_folder(folder: Path, made: Path, aside: Path) -> None:
    """Moves a folder that was made beside its place there, and what was there aside; or neither.

    Raises:
        OSError: it cannot be moved.
    """
    there = folder.exists()
    if there:
        os.rename(folder, aside)
    try:
        os.rename(made, folder)
    except BaseException:
        if there:
            os.rename(aside, folder)
        raise


def files_digest(paths: Iterable[Path]) -> str:
    """A digest of the content of files, in their order."""
    digest = hashlib.sha256()
    for path in paths:
        # Of fixed length each, so that no two sequences of files have the same.
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return f"sha256 {digest.hexdigest()}"


def claim_folder(folder: Path, name: str, described: Any, *, of: str) -> None:
    """Marks a folder, by a JSON file in it, as that of one thing's files.

    Args:
        folder: whose.
        name: of the file.
        described: what tells the thing from others; anything that JSON takes.
        of: what such a thing is called.

    Raises:
        UserError: it holds those of another.
    """
    path = folder / name
    described = json.loads(json.dumps(described, default=str))
    if not path.exists():
        others = sorted(item.name for item in folder.iterdir() if not item.name.startswith("."))
        if others:
            raise UserError(f"{folder} holds {others[0]} of something else: give another --output")
    if path.exists():
        try:
            found = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise UserError(f"{path} is damaged: give another --output, or delete {folder}") from (
                error
            )
        # Of tools or paints the order counts too.
        if json.dumps(found) != json.dumps(described):
            raise UserError(
                f"{folder} holds the files of another {of}"
                f"{_first_difference(found, described)}: give another --output, or delete it"
            )
    write_json(path, described)


def _first_difference(found: Any, described: Any) -> str:
    """Where two descriptions differ, for a person; nothing if that cannot be said in few words."""
    if not isinstance(found, dict) or not isinstance(described, dict):
        return ""
    for key in (*described, *found):
        if key not in found:
            return f" (there is no {key} there)"
        if key not in described:
            return f" (there is a {key} there)"
        old, new = found[key], described[key]
        if old != new:
            if isinstance(old, dict) and isinstance(new, dict):
                return _first_difference(old, new)
            simple = all(isinstance(value, str | float | int | None) for value in (old, new))
            return f" ({key} is {new}, there {old})" if simple else f" ({key} differs)"
    for key, new in described.items():
        if json.dumps(found[key]) != json.dumps(new):
            return _first_difference(found[key], new) or f" ({key} differs)"
    return f" ({', '.join(described)} were in the order {', '.join(found)})"


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keeps a second process out of a folder while one is at work there.

    Raises:
        MachineError: the folder cannot be written to.
        UserError: there is one already.
    """
    path = folder / ".lock"
    try:
        lock = path.open("w")
    except OSError as error:
        raise MachineError(f"cannot write {path}: {error.strerror}") from error
    with lock as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(
                f"another process is at work in {folder}: wait for it, or give another --output"
            ) from error
        except OSError as error:
            raise UserError(f"{folder} cannot be locked: {error.strerror}") from error
        yield


def append_line(path: Path, item: Any) -> None:
    """Adds an object to a file of JSON lines, and sees to it that it is on the disk.

    Raises:
        MachineError: it cannot be written; `read_lines` cuts off what was.
    """
    try:
        with path.open("a") as file:
            file.write(json.dumps(item) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise MachineError(f"cannot write {path}: {error.strerror}") from error


def read_lines(path: Path) -> list[Any]:
    """The objects of a file of JSON lines; none if there is no file.

    A last line without an end, which was being written when the process was killed, is cut off.

    Raises:
        UserError: another line is damaged.
    """
    if not path.exists():
        return []
    try:
        content = path.read_text()
    except ValueError as error:
        raise UserError(f"{path} is damaged: it is not text") from error
    whole = content[: content.rfind("\n") + 1]
    if whole != content:
        write_atomically(path, whole)
    try:
        return [json.loads(line) for line in whole.splitlines()]
    except ValueError as error:
        raise UserError(f"{path} is damaged: {error}") from error
