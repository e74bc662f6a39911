"""Prints a table of the available tools (`hkd list`)."""

from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.catalogue import CatalogueError, ToolEntry
from kitting_drake.hkd.tools.tool import load_tool, user_tool_names, user_tools

_LIST_WIDTH = 1000
"""A width of the console, in columns, at which no cell is truncated."""


def chosen_entries(entries: list[ToolEntry], names: list[str]) -> list[ToolEntry]:
    """Returns the named entries in the catalogue's order, or all entries if no name is given.

    Raises:
        CatalogueError: a name is not in the catalogue.
    """
    known = {entry.name for entry in entries}
    for name in names:
        if name not in known:
            raise CatalogueError(
                f"no tool is called {name!r}: the catalogue has {', '.join(sorted(known))}"
            )
    return [entry for entry in entries if not names or entry.name in names]


def chosen_with_own(
    entries: list[ToolEntry], names: list[str]
) -> tuple[list[ToolEntry], list[str]]:
    """Returns the catalogue's entries and the user's own tools with the given names.

    Without names, it returns all of them.

    Raises:
        CatalogueError: a name is unknown.
    """
    own = [name for name in user_tool_names() if not names or name in names]
    known = [name for name in names if name not in own]
    return [] if names and not known else chosen_entries(entries, known), own


def print_tools(models: Path, entries: list[ToolEntry], names: list[str], console: Console) -> None:
    """Prints a table of the generated tools and the user's tools, and a line for each broken tool.

    Args:
        models: the folder with `tools/`.
        entries: the entries of the catalogue.
        names: the tools to print; all of them if empty.
        console: the console to print to; it is widened to the table's width.

    Raises:
        CatalogueError: a name is unknown, or a tool has not been generated.
    """
    chosen, own = chosen_with_own(entries, names)
    records = [_record(models, entry.name) for entry in chosen]
    broken = []
    for name in own:
        try:
            load_tool(str(user_tools() / name))
        except UserError as error:
            broken.append(f"not listed: {error}")
            continue
        records.append(yaml.safe_load((user_tools() / name / "tool.yaml").read_text()))
    table = _table(records)
    # Never truncate names, because users copy them into other commands.
    wide = console.options.update(width=_LIST_WIDTH)
    console.width = max(console.width, Measurement.get(console, wide, table).maximum)
    console.print(table)
    for line in broken:
        console.print(line, highlight=False, soft_wrap=True)


def _record(models: Path, name: str) -> dict[str, Any]:
    path = models / "tools" / name / "tool.yaml"
    if not path.exists():
        raise CatalogueError(
            f"{path} is missing: run `python -m kitting_drake.hkd generate {name}` first"
        )
    return yaml.safe_load(path.read_text())


def _table(records: list[dict[str, Any]]) -> Table:
    table = Table()
    for heading in ("name", "category", "split"):
        table.add_column(heading, no_wrap=True)
    for heading in ("size, mm", "mass, g", "grasp, mm"):
        table.add_column(heading, justify="right", no_wrap=True)
    # Add a column of symmetries only if a tool has one, to keep the table narrow.
    symmetric = any(record.get("symmetry", 1) != 1 for record in records)
    if symmetric:
        table.add_column("symmetry", justify="right", no_wrap=True)
    for record in records:
        row = (
            record["name"],
            record["category"],
            record["split"],
            size_text(record),
            f"{1e3 * record['mass']:.0f}",
            f"{1e3 * record['grasp']['width']:.1f}",
        )
        table.add_row(*row, *([str(record.get("symmetry", 1))] if symmetric else []))
    return table


def size_text(record: dict[str, Any]) -> str:
    """Returns a tool's length, width and height in mm as text, from its record."""
    return " x ".join(f"{1e3 * record[key]:.0f}" for key in ("length", "width", "height"))
