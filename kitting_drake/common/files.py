"""Writes files atomically, and reserves output folders for one run and one process."""

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
    """Writes a file atomically and creates its folder if needed.

    Raises:
        MachineError: writing fails.
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
    """Writes a value to a file as indented JSON, atomically."""
    write_atomically(path, json.dumps(value, indent=2) + "\n")


def require_folder(path: Path) -> Path:
    """Creates a folder for the output of a run, and checks that it is writable.

    Raises:
        MachineError: creating or writing fails.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise MachineError(f"cannot write into {path}: {error.strerror}") from error


def replace_folder(folder: Path, made: Path, aside: Path) -> None:
    """Moves the existing `folder` to `aside`, and then `made` to `folder`. If a move fails, both
    folders stay where they were.

    Raises:
        OSError: moving fails.
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
    """A digest of the contents of files in the given order."""
    digest = hashlib.sha256()
    for path in paths:
        # Hash each file separately, so that the digest depends on where one file ends and the next
        # begins.
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return f"sha256 {digest.hexdigest()}"


def claim_folder(folder: Path, name: str, described: Any, *, of: str) -> None:
    """Marks a folder with a JSON file as the output of one run.

    Args:
        folder: the folder.
        name: the name of the JSON file.
        described: the run's description, serializable as JSON.
        of: what identifies a run, such as `scenario or version`. It completes the error message
            "the folder holds the files of another ...".

    Raises:
        UserError: the folder contains other files, or those of a different run.
    """
    path = folder / name
    described = json.loads(json.dumps(described, default=str))
    if not path.exists():
        others = sorted(item.name for item in folder.iterdir() if not item.name.startswith("."))
        if others:
            raise UserError(
                f"{folder} holds other files, such as {others[0]}: give another --output"
            )
    else:
        try:
            found = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise UserError(
                f"{path} is damaged: give another --output, or delete {folder}"
            ) from error
        # Compare the order of keys as well, because the order of tools or paints matters.
        if json.dumps(found) != json.dumps(described):
            raise UserError(
                f"{folder} holds the files of another {of}"
                f"{_first_difference(found, described)}: delete them, or give another --output"
            )
    write_json(path, described)


def _first_difference(found: Any, described: Any) -> str:
    """Describes the first difference of two descriptions; empty if they are not mappings."""
    if not isinstance(found, dict) or not isinstance(described, dict):
        return ""
    for key in (*described, *found):
        if key not in found:
            return f" (it has no {key})"
        if key not in described:
            return f" (it has a {key})"
        old, new = found[key], described[key]
        if old != new:
            if isinstance(old, dict) and isinstance(new, dict):
                return _first_difference(old, new)
            simple = all(isinstance(value, str | float | int | None) for value in (old, new))
            return f" ({key} is {new}, but {old} in them)" if simple else f" ({key} differs)"
    for key, new in described.items():
        if json.dumps(found[key]) != json.dumps(new):
            return _first_difference(found[key], new) or f" ({key} differs)"
    return f" ({', '.join(described)} are there in the order {', '.join(found)})"


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Locks a folder against other processes.

    Raises:
        MachineError: the folder is not writable.
        UserError: another process has locked it.
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
                f"another process is writing to {folder}: "
                "wait until it ends, or give another --output"
            ) from error
        except OSError as error:
            raise UserError(f"{folder} cannot be locked: {error.strerror}") from error
        yield


def append_line(path: Path, item: Any) -> None:
    """Appends an object to a JSON Lines file and syncs it to disk.

    Raises:
        MachineError: writing fails. A partial line may remain, which `read_lines` removes.
    """
    try:
        with path.open("a") as file:
            file.write(json.dumps(item) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise MachineError(f"cannot write {path}: {error.strerror}") from error


def read_lines(path: Path) -> list[Any]:
    """Reads the objects of a JSON Lines file; empty if the file does not exist.

    An incomplete last line, left by a killed process, is removed from the file.

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
