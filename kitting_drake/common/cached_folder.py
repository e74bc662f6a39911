"""A cache of folders that can be recreated. Folders appear atomically, and the least recently used
ones are removed."""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from kitting_drake.common.errors import MachineError

KEPT_ENTRIES = 1000
"""Number of most recently used folders that `prune` always keeps."""

YOUNGEST_REMOVED = 3600.0
"""`prune` keeps folders used within this time, in seconds, because a running process may need
them."""

_SCRATCH = ".making-"


def cached_folder(final: Path, files: Sequence[str], write: Callable[[Path], object]) -> Path:
    """Returns a folder of the cache, after creating it if it is missing or damaged.

    The folder appears atomically, so several processes may create it at the same time. Every use
    renews the folder's modification time, by which `prune` finds the least recently used folders.

    Args:
        final: the folder. Its name must identify its content.
        files: the names of the files in the folder.
        write: a function that writes the files into the empty folder that it gets.

    Raises:
        MachineError: the cache is not writable.
    """
    # Renew the modification time first, so that another process does not remove the folder
    # meanwhile.
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
                # The folder is damaged: after a power failure, for example, files may be empty.
                os.rename(final, Path(folder) / "damaged")
            os.rename(scratch, final)
    except OSError as error:
        # Another process may have created the same folder meanwhile.
        if not _is_complete(final, files):
            raise MachineError(f"cannot write to {final.parent}: {error.strerror}") from error
    prune(final.parent)
    return final


def _is_complete(folder: Path, files: Sequence[str]) -> bool:
    sizes = [(folder / name).stat().st_size for name in files if (folder / name).is_file()]
    return len(sizes) == len(files) and all(sizes)


def prune(parent: Path) -> None:
    """Removes the least recently used folders in `parent`.

    It keeps the `KEPT_ENTRIES` most recently used folders, and all others that were used within the
    last `YOUNGEST_REMOVED` seconds. Older scratch folders of killed processes are removed as well.
    """
    entries: list[tuple[float, Path]] = []
    for path in parent.iterdir():
        # Another process may remove the folder meanwhile.
        with contextlib.suppress(OSError):
            entries.append((path.stat().st_mtime, path))
    scratch = [path for _, path in entries if path.name.startswith(_SCRATCH)]
    kept = [(time_, path) for time_, path in entries if path not in scratch]
    kept.sort(key=lambda entry: entry[0], reverse=True)
    for path in [*(path for _, path in kept[KEPT_ENTRIES:]), *scratch]:
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > YOUNGEST_REMOVED:
                # Move the folder away first, so that no process finds it half deleted.
                with tempfile.TemporaryDirectory(dir=parent, prefix=_SCRATCH) as folder:
                    os.rename(path, Path(folder) / "removed")
                    shutil.rmtree(Path(folder) / "removed", ignore_errors=True)
