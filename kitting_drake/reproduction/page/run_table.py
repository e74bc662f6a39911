"""Reads and writes two files with the summaries of all runs. The pages of results use these files.

`runs.csv` has one row per run, with the short fields of the `summary.json` of `evaluate`. A nested
field has a column such as `versions.drake`. An empty cell means that the run lacks the field.
`episodes.jsonl.xz` is compressed and has one line per run with the other fields: `outcomes` (the
success rate of each episode, and how each object ended), `categories` and `resolved_scenario`. The
two files together hold every summary in full.
"""

import csv
import io
import json
import lzma
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in, require_folder, write_atomically

Summary = dict[str, Any]
"""The content of a `summary.json`."""

TABLE = "runs.csv"
EPISODES = "episodes.jsonl.xz"
_NAME = "run"
"""The key of a run's name: a column of the table, and a field of each line of `EPISODES`."""
_LONG = ("categories", "outcomes", "resolved_scenario")
"""The fields that are in `EPISODES` instead of the table."""


def read_summaries(folder: Path) -> dict[str, Summary]:
    """Returns the summaries of all runs, by name; empty if there are no files.

    Raises:
        UserError: a file is damaged, or `TABLE` and `EPISODES` do not have the same runs.
    """
    rows, lines = _read_table(folder / TABLE), _read_lines(folder / EPISODES)
    for name in sorted(rows.keys() ^ lines.keys()):
        has, lacks = (TABLE, EPISODES) if name in rows else (EPISODES, TABLE)
        raise UserError(
            f"{folder / lacks} lacks the run '{name}', which {has} has: restore the files, or add "
            "the run again (--add), or remove it (--remove)"
        )
    return {name: row | lines[name] for name, row in sorted(rows.items())}


def add_run(folder: Path, name: str, summary: Mapping[str, Any]) -> None:
    """Adds a run to `TABLE` and `EPISODES`; creates these files if necessary.

    Args:
        folder: the folder of the files.
        name: the name of the run.
        summary: the summary from `evaluate`.

    Raises:
        UserError: another run has this name, or a file is damaged.
    """
    require_folder(folder)
    with alone_in(folder):
        rows, lines = _read_table(folder / TABLE), _read_lines(folder / EPISODES)
        row = {key: value for key, value in summary.items() if key not in _LONG}
        line = {key: summary[key] for key in _LONG if key in summary}
        if rows.get(name, row) != row or lines.get(name, line) != line:
            raise UserError(
                f"{folder / TABLE} already has a run '{name}': give another name, or remove that "
                f"run first (--remove {name})"
            )
        _write(folder, rows | {name: row}, lines | {name: line})


def remove_runs(folder: Path, names: Collection[str]) -> None:
    """Removes runs from both files.

    Raises:
        UserError: there is no such run, or a file is damaged.
    """
    with alone_in(folder):
        rows, lines = _read_table(folder / TABLE), _read_lines(folder / EPISODES)
        for name in names:
            if name not in rows.keys() | lines.keys():
                raise UserError(f"{folder / TABLE} has no run '{name}' to remove")
            rows.pop(name, None)
            lines.pop(name, None)
        _write(folder, rows, lines)


def _write(folder: Path, rows: Mapping[str, Summary], lines: Mapping[str, Summary]) -> None:
    text = "".join(json.dumps({_NAME: name, **line}) + "\n" for name, line in sorted(lines.items()))
    flat = {name: _flatten(row) for name, row in sorted(rows.items())}
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, [_NAME, *_columns(flat.values())], lineterminator="\n")
    writer.writeheader()
    writer.writerows({_NAME: name, **row} for name, row in flat.items())
    # Write the table last, because a run without a row is detected and can be added again.
    write_atomically(folder / EPISODES, lzma.compress(text.encode()))
    write_atomically(folder / TABLE, table.getvalue())


def _columns(rows: Iterable[Mapping[str, str]]) -> list[str]:
    """Returns the columns of all rows.

    A column that is new in a row is inserted after its left neighbour in that row.
    """
    columns: list[str] = []
    for row in rows:
        place = 0
        for name in row:
            if name in columns:
                place = max(place, columns.index(name) + 1)
            else:
                columns.insert(place, name)
                place += 1
    return columns


def _flatten(value: Any, column: str = "") -> dict[str, str]:
    """Returns the cells of a value, by column."""
    if isinstance(value, dict) and value and not any("." in key for key in value):
        cells: dict[str, str] = {}
        for key, item in value.items():
            cells |= _flatten(item, f"{column}.{key}" if column else key)
        return cells
    return {column: _cell(value, column)}


def _cell(value: Any, column: str) -> str:
    """Returns a value as JSON, or as plain text if that is unambiguous."""
    if isinstance(value, str) and value and _value(value, column) == value:
        return value
    if column == "seeds" and value and value == list(range(value[0], value[-1] + 1)):
        return f"{value[0]}-{value[-1]}"
    return json.dumps(value)


def _value(cell: str, column: str) -> Any:
    if column == "seeds" and (ends := re.fullmatch(r"(\d+)-(\d+)", cell)):
        return list(range(int(ends[1]), int(ends[2]) + 1))
    try:
        return json.loads(cell)
    except ValueError:
        return cell


def _unflatten(row: Mapping[str, str]) -> Summary:
    summary: Summary = {}
    for column, cell in row.items():
        if cell:
            *parents, key = column.split(".")
            inner = summary
            for parent in parents:
                inner = inner.setdefault(parent, {})
            inner[key] = _value(cell, column)
    return summary


def _read_table(path: Path) -> dict[str, Summary]:
    rows: dict[str, Summary] = {}
    try:
        content = path.read_bytes().decode() if path.exists() else ""
        if content and not content.endswith("\n"):
            raise ValueError("its last line is incomplete")
        for row in csv.DictReader(io.StringIO(content, newline=""), strict=True):
            name = row.pop(_NAME)
            # Surplus cells have the key None; missing cells have the value None.
            if not name or name in rows or None in (*row, *row.values()):
                raise ValueError(f"the row '{name}' is repeated or has the wrong length")
            rows[name] = _unflatten(row)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, csv.Error) as error:
        raise _damaged(path, error) from error
    return rows


def _read_lines(path: Path) -> dict[str, Summary]:
    try:
        content = lzma.decompress(path.read_bytes()).decode() if path.exists() else ""
        found = [json.loads(line) for line in content.splitlines()]
        return {line.pop(_NAME): line for line in found}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, lzma.LZMAError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} is damaged ({error}): restore it, for example from git")
