"""Makes a tool from a mesh or an outline (`hkd import`).

1. A mesh is read and repaired (`repair`), or an outline is extruded (`outline`).
2. The solid is moved to the tool frame, in a stable pose (`tool_frame`), and scaled.
3. It gets a grasp (`fit`), a mass (`materials`) and collision hulls (`convex_decomposition`).
4. A simulation checks in which pose it comes to rest (`resting_pose`).

All this happens in a child process, because geometry libraries may crash or hang on broken meshes.
The tool's folder appears atomically. Solids are handled in mm and written in metres.
"""

import contextlib
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import replace_folder
from kitting_drake.hkd.importing.import_request import ImportRequest, check_request, checked_name
from kitting_drake.hkd.importing.own_process import MOST_WAITING, TIME_LIMIT, prepare_aside
from kitting_drake.hkd.importing.prepare import digest_of, prepare_tool
from kitting_drake.hkd.tools.tool import user_tools

_MAKING = ".making-"
"""The prefix of the folders of unfinished tools."""


@dataclass(frozen=True)
class ImportReport:
    """The result of `import_tool`."""

    directory: Path
    record: dict[str, Any]
    """The tool's record, as in `tool.yaml`."""
    notes: list[str]
    """Phrases for the user on assumptions and repairs."""
    collision_hulls: int
    """The number of collision hulls."""


def import_tool(request: ImportRequest, time_limit: float | None = TIME_LIMIT) -> ImportReport:
    """Makes a tool's folder from a mesh or an outline.

    Args:
        request: the file to import, and the properties of the tool.
        time_limit: the limit of the child process's processor time, in seconds. None: there is no
            child process; this process makes the tool.

    Raises:
        UserError: the tool cannot be made; nothing is written then.
    """
    check_request(request)
    name = checked_name(request)
    folder = request.output or user_tools()
    final = folder / name
    if final.exists():
        _check_replaceable(final, request)
    new_folders = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix=_MAKING) as scratch:
            made = Path(scratch) / name
            made.mkdir()
            report = (
                prepare_tool(request, name, made)
                if time_limit is None
                else prepare_aside(request, name, made, time_limit)
            )
            # Check again, because another process may have made the folder in the meantime.
            replaced = _check_replaceable(final, request) if final.exists() else None
            replace_folder(final, made, Path(scratch) / "replaced")
            record, notes, hulls = report
            if replaced is not None:
                notes = [*notes, replaced]
            return ImportReport(final, record, notes, hulls)
    except OSError as error:
        raise UserError(f"cannot write {final}: {error.strerror}") from error
    finally:
        for path in new_folders:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _remove_abandoned(folder: Path) -> None:
    """Removes the unfinished folders that killed imports left behind."""
    for path in folder.glob(f"{_MAKING}*"):
        # Ignore errors, because another import may remove the folder at the same time.
        with contextlib.suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > 2 * MOST_WAITING * TIME_LIMIT:
                shutil.rmtree(path, ignore_errors=True)


def _check_replaceable(folder: Path, request: ImportRequest) -> str | None:
    """Checks that a folder may be replaced.

    Returns:
        A note for the user if the content of the imported file has changed; else None.

    Raises:
        UserError: the folder is not an imported tool, comes from a file of another name, or has a
            grasp that the user saved.
    """
    try:
        record = yaml.safe_load((folder / "tool.yaml").read_text())
        file, digest = record["imported"]["file"], record["imported"]["sha256"]
        annotated = record.get("annotated")
    except (OSError, yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise UserError(
            f"{folder} exists and is not an imported tool: give another --name"
        ) from error
    if annotated:
        raise UserError(
            f"{folder} has a grasp that you saved: give another --name, or delete the folder"
        )
    if file != request.mesh.name:
        raise UserError(f"{folder} was made from {file}: give another --name, or delete the folder")
    if request.mesh.is_file() and digest != digest_of(request.mesh):
        return f"replaces the tool of an older version of {file}"
    return None
