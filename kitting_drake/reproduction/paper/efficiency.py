"""Writes the section on figure 6(c), the cost of predicting the pick angle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.evaluation.quantities import count_text, ratio_text, seconds_text
from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import LEARNED, METHODS

EFFICIENCY = "networks.json"
"""A copy of the output of `benchmark networks`, beside the results."""


def read_efficiency(folder: Path) -> dict[str, Any] | None:
    """Reads the measurements of `benchmark networks`; returns None if there is no file.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / EFFICIENCY
    if not path.exists():
        return None
    try:
        measured: dict[str, Any] = json.loads(path.read_text())
        efficiency_section(measured)
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(f"{path} was not written by benchmark networks: delete it") from error
    return measured


def efficiency_section(measured: Mapping[str, Any]) -> str:
    """Writes the section on figure 6(c).

    Args:
        measured: the result of `benchmark_networks`.
    """
    machine = measured["machine"]
    place = machine["cpu"] if machine["device"] == "cpu" else machine["device"]
    growths = {(row["method"], row["preset"]): row for row in measured["pick_angle_growth"]}
    presets = list(dict.fromkeys(row["preset"] for row in measured["pick_angle"]))
    ends = growths[LEARNED[0], presets[0]]
    counts = [
        n
        for n in sorted({row["orientations"] for row in measured["pick_angle"]})
        if ends["from"] <= n <= ends["to"]
    ]
    rows = []
    for preset in presets:
        for method in LEARNED[:2]:
            by_n = {
                row["orientations"]: row
                for row in measured["pick_angle"]
                if (row["method"], row["preset"]) == (method, preset)
            }
            growth = growths[method, preset]
            rows.append(
                [
                    METHODS[method],
                    preset,
                    *(_cost_text(by_n[n]) for n in counts),
                    f"{ratio_text(growth['parameters'])}, {ratio_text(growth['seconds'])}",
                ]
            )
    text = prose(
        "efficiency",
        machine=f"{place}, {machine['threads']} threads",
        type=measured["inference_type"],
        repeats=measured["repeats"],
        fewest=ends["from"],
        most=ends["to"],
    )
    headings = ["method", "preset", *(f"N = {n}" for n in counts), "growth"]
    return f"{text}\n{markdown_table(headings, rows, left_columns=2)}"


def _cost_text(row: Mapping[str, Any]) -> str:
    """Returns, as text, the number of parameters and the time, or the reason why there is no
    time."""
    return f"{count_text(row['parameters'])}, {row['skipped'] or seconds_text(row['seconds'])}"
