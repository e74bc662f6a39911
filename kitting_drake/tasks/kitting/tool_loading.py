"""Loads the tools that a kitting task names, and checks that the hand can hold them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.kits.layout import MOST_TOOLS
from kitting_drake.hkd.tools.tool import Tool
from systems.hand_geometry import MAX_OPENING

ANNOTATE = "save another grasp with `hkd annotate`"


def check_grasps(tools: Sequence[Tool], advice: str) -> None:
    """Raises UserError, with advice, if a tool's grasp is wider than the open jaws."""
    for tool in tools:
        if tool.grasp.width >= MAX_OPENING:
            raise UserError(
                f"task: at a length of {1e3 * tool.length:.0f} mm the tool '{tool.name}' is "
                f"{1e3 * tool.grasp.width:.0f} mm wide where it is held, but the jaws open to "
                f"{1e3 * MAX_OPENING:.0f} mm only: {advice}"
            )


def load_tools(names: Iterable[str], base: Path, field: str = "task.tools") -> list[Tool]:
    """Loads tools or simple parts by their names or folders. Each is read only once.

    Args:
        names: names or folders; repetitions are allowed.
        base: base folder of relative paths.
        field: the scenario's field with the names, for error messages.

    Raises:
        UserError: a tool does not exist.
    """
    names = list(names)
    loaded = {name: _load_tool(name, base, field) for name in dict.fromkeys(names)}
    return [loaded[name] for name in names]


def _load_tool(name: str, base: Path, field: str) -> Tool:
    try:
        return load_named(name, base)
    except UserError as error:
        raise type(error)(f"{field}: {error}") from error


def tool_files(names: Iterable[str], base: Path) -> list[Path]:
    """Returns the files in the folders of tools. For the arguments see `load_tools`."""
    folders = [tool.directory for tool in load_tools(names, base)]
    return [path for folder in folders for path in sorted(folder.iterdir()) if path.is_file()]


def check_count(count: int, kits: int = 1) -> None:
    """Raises ValueError if there are no tools, or too many for the kits."""
    if not count:
        raise ValueError("task.tools is empty: name at least one tool")
    if count > kits * MOST_TOOLS:
        raise ValueError(
            f"task.tools has {count} tools: name at most {kits * MOST_TOOLS}, because a kit holds "
            f"up to {MOST_TOOLS}"
        )
