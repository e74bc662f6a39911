"""`hkd import`: makes a tool from a mesh or an outline.

The mesh is read and repaired (`repair`) or extruded from an outline (`outline`). It is brought into
the tool frame in a stable pose (`tool_frame`), scaled, and given a grasp (`fit`), a mass
(`materials`) and collision hulls (`convex_decomposition`). Finally a simulation checks how it comes
to rest (`resting_pose`). All this happens in a child process, which may crash or hang, and the
tool's folder appears atomically. Solids are handled in mm and written in metres.
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
    """The tool that was made."""

    directory: Path
    record: dict[str, Any]
    """The tool's record, as in `tool.yaml`."""
    notes: list[str]
    """The assumptions and repairs, one phrase each."""
    collision_hulls: int
    """The number of collision hulls."""


def import_tool(request: ImportRequest, time_limit: float | None = TIME_LIMIT) -> ImportReport:
    """Makes a tool's folder from a mesh or an outline.

    Args:
        request: the file to import.
        time_limit: seconds of processor time of the child process; None runs in this process.

    Raises:
        UserError: the tool cannot be made; nothing was written then.
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
            # Another run may have made it in the meantime.
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
    """Removes unfinished folders of killed imports."""
    for path in folder.glob(f"{_MAKING}*"):
        # Another import may remove the folder at the same time.
        with contextlib.suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > 2 * MOST_WAITING * TIME_LIMIT:
                shutil.rmtree(path, ignore_errors=True)


def _check_replaceable(folder: Path, request: ImportRequest) -> str | None:
    """Checks that a folder may be replaced; returns a note if the file's content has changed.

    Raises:
        UserError: the folder is not an imported tool, comes from a file of another name, or has an
            annotated grasp.
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
        raise UserError(f"{folder} has a grasp that you saved: give another --name, or delete it")
    if file != request.mesh.name:
        raise UserError(f"{folder} is the tool of {file}: give another --name, or delete it")
    if request.mesh.is_file() and digest != digest_of(request.mesh):
        return f"replaces the tool of an older {file}"
    return None
