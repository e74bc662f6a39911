"""Folders of files that can be made again: they appear atomically, and the oldest are removed."""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from kitting_drake.common.errors import MachineError

KEPT_ENTRIES = 1000
"""The number of folders that `prune` leaves."""

YOUNGEST_REMOVED = 3600.0
"""The age in seconds below which `prune` removes nothing: a running process may need it."""

_SCRATCH = ".making-"


def cached_folder(final: Path, files: Sequence[str], write: Callable[[Path], object]) -> Path:
    """A folder from the cache, made there if it is missing or damaged.

    The folder appears atomically, and two processes that make the same one do not disturb each
    other. Every use renews its modification time, by which `prune` chooses what to keep.

    Args:
        final: the folder. Its name has to identify its content.
        files: the names of the files that it holds.
        write: writes them into an empty folder.

    Raises:
        MachineError: the cache cannot be written.
    """
    # Renewed before it is looked at, so that it is not removed in between.
    with contextlib.suppress(OSError):
        os.utime(final)
    if _is_complete(final, files):
        return final
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=final.parent, prefix=_SCRATCH) as folder:
            scratch = Path(folder) / "made"
            scratch.mkdir()
            write(scratch)
            if final.exists() and not _is_complete(final, files):
                # A machine that lost power may have left names without content.
                os.rename(final, Path(folder) / "damaged")
            os.rename(scratch, final)
    except OSError as error:
        # Another process may have been quicker: its folder is the same.
        if not _is_complete(final, files):
            raise MachineError(f"cannot write to {final.parent}: {error.strerror}") from error
    prune(final.parent)
    return final


def _is_complete(folder: Path, files: Sequence[str]) -> bool:
    sizes = [(folder / name).stat().st_size for name in files if (folder / name).is_file()]
    return len(sizes) == len(files) and all(sizes)


def prune(parent: Path) -> None:
    """Removes the folders in `parent` that were used longest ago.

    The newest `KEPT_ENTRIES` stay, and so does everything younger than `YOUNGEST_REMOVED`. Scratch
    folders of processes that were killed are removed at the same age.
    """
    entries: list[tuple[float, Path]] = []
    for path in parent.iterdir():
        # Another process may remove it meanwhile.
        with contextlib.suppress(OSError):
            entries.append((path.stat().st_mtime, path))
    scratch = [path for _, path in entries if path.name.startswith(_SCRATCH)]
    kept = [(time_, path) for time_, path in entries if path not in scratch]
    kept.sort(key=lambda entry: entry[0], reverse=True)
    for path in [*(path for _, path in kept[KEPT_ENTRIES:]), *scratch]:
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > YOUNGEST_REMOVED:
                # Moved away first, so that nobody finds half of it.
                with tempfile.TemporaryDirectory(dir=parent, prefix=_SCRATCH) as folder:
                    os.rename(path, Path(folder) / "removed")
                    shutil.rmtree(Path(folder) / "removed", ignore_errors=True)
