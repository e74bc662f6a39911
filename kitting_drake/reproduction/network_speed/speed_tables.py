"""Makes tables of the results of `benchmark networks`, for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rich.table import Table

from kitting_drake.evaluation.quantities import (
    count_text,
    numbers_table,
    ratio_text,
    seconds_text,
)

METHOD_NAMES = {
    "so2": "SO(2)",
    "equivariant_transporter": "Equiv. Transporter",
    "transporter": "Transporter",
}
RUNG_NAMES = {
    "escnn_float32": "escnn, float32",
    "escnn_bfloat16": "escnn, bfloat16 autocast",
    "ours_float32": "folded, float32",
    "ours_bfloat16": "folded, bfloat16",
}
MEASURE_NAMES = {
    "training_step": "training step, all networks",
    "alpha_training_step": "training step, alpha",
    "decision": "decision",
    "alpha_inference": "inference, alpha",
}


def network_tables(measured: dict[str, Any]) -> list[Table]:
    """Returns all tables of `benchmark networks`.

    Args:
        measured: the result of `benchmark_networks`.
    """
    presets = dict.fromkeys(row["preset"] for row in measured["pick_angle"])
    return [
        *(_pick_angle_table(measured, preset) for preset in presets),
        _decision_table(measured),
        _folding_table(measured),
        _share_table(measured),
        _level_table(measured),
    ]


def _milliseconds_text(seconds: float | None) -> str:
    """Returns a time in ms as text, without the unit."""
    if seconds is None:
        return "-"
    return f"{1e3 * seconds:.0f}" if seconds >= 0.1 else f"{1e3 * seconds:.2g}"


def _add_by_method(
    table: Table,
    rows: list[dict[str, Any]],
    growths: list[dict[str, Any]],
    cells: Callable[[dict[str, Any]], Iterable[str]],
    growth_cells: Callable[[dict[str, Any]], Iterable[str]],
) -> None:
    """Adds the lines of each method to a table: one for each N, and one for the growth.

    The growth is the ratio of the values at the largest and the smallest N.
    """
    for method in dict.fromkeys(row["method"] for row in rows):
        chosen = [row for row in rows if row["method"] == method]
        for row in chosen:
            table.add_row(METHOD_NAMES[method], str(row["orientations"]), *cells(row))
        key = (chosen[0]["preset"], method)
        growth = next(row for row in growths if (row["preset"], row["method"]) == key)
        ends = f"{growth['to']}/{growth['from']}"
        table.add_row("", ends, *growth_cells(growth), style="bold", end_section=True)


def _pick_angle_table(measured: dict[str, Any], preset: str) -> Table:
    table = numbers_table(
        f"models that predict the pick angle, preset {preset} (Transporter: all of its picking); "
        "MAC: multiply-accumulates",
        "method",
        "N",
        "parameters",
        "MAC",
        "time",
    )
    _add_by_method(
        table,
        [row for row in measured["pick_angle"] if row["preset"] == preset],
        measured["pick_angle_growth"],
        lambda row: (
            count_text(row["parameters"]),
            count_text(row["operations"] / 2),
            row["skipped"] or seconds_text(row["seconds"]),
        ),
        lambda growth: (ratio_text(growth[key]) for key in ("parameters", "operations", "seconds")),
    )
    return table


def _decision_table(measured: dict[str, Any]) -> Table:
    headings = {
        "pick_position": "pixel",
        "pick_angle": "angle",
        "phi": "phi",
        "psi": "psi",
        "search": "search",
    }
    table = numbers_table(
        f"a decision, in ms, preset {measured['preset']}, {measured['inference_type']}",
        "method",
        "N",
        *headings.values(),
        "all",
    )
    _add_by_method(
        table,
        measured["decision"],
        measured["decision_growth"],
        lambda row: (
            *(_milliseconds_text((row["parts"] or {}).get(part)) for part in headings),
            row["skipped"] or _milliseconds_text(row["seconds"]),
        ),
        lambda growth: (*[""] * len(headings), ratio_text(growth["seconds"])),
    )
    return table


def _folding_table(measured: dict[str, Any]) -> Table:
    folding = measured["folding"]
    rungs = list(folding["rungs"])
    operations = {name: count_text(n / 2) for name, n in folding["alpha_operations"].items()}
    table = numbers_table(
        f"the same networks, preset {measured['preset']}: time, and times faster than escnn's "
        f"float32 (MAC of alpha: escnn {operations['escnn']}, folded {operations['ours']})",
        "what",
        *(RUNG_NAMES[rung] for rung in rungs),
    )
    for name, title in MEASURE_NAMES.items():
        cells = [
            f"{seconds_text(folding['rungs'][rung][name]['seconds'])}\n"
            f"[bold]{folding['speed_up'][rung][name]:.2f}x[/]"
            for rung in rungs
        ]
        table.add_row(title, *cells)
    for name in ("training_step", "decision"):
        shares = folding["convolution_share"]
        cells = [f"{shares[rung][name]:.0%}" if rung in shares else "-" for rung in rungs]
        table.add_row(f"{MEASURE_NAMES[name]}: share of its convolutions", *cells)
    differences = (folding["alpha_difference"][rung] for rung in rungs)
    table.add_row("difference of alpha's output", *(f"{value:.1e}" for value in differences))
    return table


def _share_table(measured: dict[str, Any]) -> Table:
    peaks = ", ".join(
        f"{name} {count_text(rates['best'])}FLOP/s" for name, rates in measured["peak"].items()
    )
    table = numbers_table(
        f"share of the machine's peak ({peaks})",
        "network",
        "type",
        "MAC",
        "inference",
        "share",
        "training step",
        "share",
    )
    rows = {(row["network"], row["type"], row["mode"]): row for row in measured["share_of_peak"]}
    for name, type_ in dict.fromkeys((name, type_) for name, type_, _ in rows):
        infer, train = (rows[name, type_, mode] for mode in ("inference", "training"))
        table.add_row(
            name,
            type_,
            count_text(infer["operations"] / 2),
            seconds_text(infer["seconds"]),
            f"{infer['share']:.0%}",
            seconds_text(train["seconds"]),
            f"{train['share']:.0%}",
        )
    return table


def _level_table(measured: dict[str, Any]) -> Table:
    table = numbers_table(
        f"alpha's inference, preset {measured['preset']}, level by level",
        "level",
        "MAC",
        "time",
        "in convolutions",
        "their share of peak",
        "share of peak",
    )
    for row in measured["alpha_levels"]["levels"]:
        table.add_row(
            row["level"],
            count_text(row["operations"] / 2),
            seconds_text(row["seconds"]),
            seconds_text(row["convolution_s"]),
            f"{row['convolution_share']:.0%}",
            f"{row['share']:.0%}",
        )
    return table
