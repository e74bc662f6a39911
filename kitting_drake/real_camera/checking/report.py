"""Writes decisions and checks to files, and prints them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from kitting_drake.common.files import write_atomically, write_json
from kitting_drake.real_camera.calibrations.calibration import write_calibration
from kitting_drake.real_camera.checking.check import Check, TableCheck
from kitting_drake.real_camera.checking.meaning import BAD, GOOD, findings, offset, scales
from kitting_drake.real_camera.checking.table_finding import MOST_TILT, FoundTable
from systems.signals import Observation

CHECK_FILES = ("check.json", "corrected.yaml", "check.png")
"""The files that `save_check` writes."""
FOUND_FILES = ("found.yaml", "found.png")
"""The files that `save_found` writes."""
_WELL_SEEN = 0.9
"""The least share of the workspace that should be in view, and the least share of the pixels in
view that should have a depth. Lower shares are reported."""


def print_decision(console: Console, record: dict[str, Any]) -> None:
    """Prints the content of an `action.json`."""
    confidence = record["confidence"]
    sure = "" if confidence is None else f", confidence {confidence:.2f}"
    by = f"({record['policy']}, {record['seconds']:.2f} s)"
    console.print(f"{record['result']}{sure} {by}", highlight=False, markup=False)
    if record["stop"] and record["reason"]:
        console.print(f"  {record['reason']}", highlight=False, markup=False)
    for warning in record["warnings"]:
        console.print(f"  [yellow]warning:[/] {escape(warning)}", highlight=False)
    if record["in_view"] < _WELL_SEEN:
        console.print(
            f"  the cameras look at {100 * record['in_view']:.0f} % of the workspace",
            highlight=False,
        )
    if record["seen"] < _WELL_SEEN:
        console.print(
            f"  the cameras measure only {100 * record['seen']:.0f} % of the pixels in view; the "
            "others are filled in from their neighbours",
            highlight=False,
        )
    for name in ("pick", "place"):
        pose = record.get(name)
        if pose is not None:
            console.print(
                f"  {name:5}  x {pose['x']:.4f}  y {pose['y']:+.4f}  z {pose['z']:.4f} m  "
                f"yaw {math.degrees(pose['yaw']):+.1f} deg",
                highlight=False,
            )


def save_check(folder: Path, check: Check) -> None:
    """Writes `check.json`, the corrected calibration `corrected.yaml`, and `check.png`.

    Raises:
        MachineError: a file cannot be written.
    """
    # Import matplotlib lazily.
    from kitting_drake.evaluation.check_figure import draw_heights

    record, calibration, picture = (folder / name for name in CHECK_FILES)
    write_json(record, check_record(check))
    write_calibration(calibration, check.corrected)
    write_atomically(picture, draw_heights(check.heights, check.corrected.grid))


def check_record(check: Check) -> dict[str, Any]:
    """Returns a check as JSON values, in mm, degrees and percent."""
    cameras = {}
    for name, camera in check.cameras.items():
        record = {**_table(camera.table), "depth_bias_mm": _mm(camera.depth_bias)}
        if camera.block is not None and check.block is not None:
            seen = camera.block
            record["block"] = {
                "size_mm": [_mm(side) for side in seen.size],
                "scale": [round(scale, 5) for scale in scales(seen, check.block)],
                "corner_deg": round(math.degrees(seen.corner), 3),
                "middle": seen.middle.tolist(),
                "yaw": seen.yaw,
            }
            off = offset(seen, check.block)
            if off is not None:
                record["block"]["offset_mm"] = [_mm(off[0]), _mm(off[1])]
                record["block"]["offset_deg"] = round(math.degrees(off[2]), 3)
        cameras[name] = record
    return {
        "cameras": cameras,
        "together": _table(check.together),
        "disagreement_mm": {
            f"{one}, {other}": _mm(height) for (one, other), height in check.disagreements.items()
        },
        "block_disagreement_mm": {
            f"{one}, {other}": [_mm(value) for value in shift]
            for (one, other), shift in check.block_shifts.items()
        },
    }


def print_check(console: Console, check: Check) -> None:
    """Prints the findings, and their effect on a clearance of 2 mm."""
    table = Table(box=None, pad_edge=False)
    for title in ("camera", "", "", "2 mm clearance", "meaning"):
        table.add_column(title, overflow="fold")
    last = ""
    for line in findings(check):
        colour = {GOOD: "green", BAD: "red"}.get(line.verdict, "yellow")
        table.add_row(
            escape(line.who) if line.who != last else "",
            line.what,
            line.value,
            f"[{colour}]{line.verdict}[/]",
            line.meaning,
            end_section=False,
        )
        last = line.who
    console.print(table, highlight=False)
    console.print("corrected poses: corrected.yaml", highlight=False)


def save_found(folder: Path, found: FoundTable, observation: Observation) -> None:
    """Writes the proposed calibration `found.yaml`, and the picture `found.png`.

    Args:
        folder: the folder for the files.
        found: the proposal.
        observation: the heightmap over the grid `found.around`.

    Raises:
        MachineError: a file cannot be written.
    """
    # Import matplotlib lazily.
    from kitting_drake.evaluation.found_figure import draw_found

    calibration, picture = (folder / name for name in FOUND_FILES)
    write_calibration(calibration, found.calibration)
    outline = found.calibration.outline
    drawn = draw_found(observation, found.calibration.grid, outline.region, outline.ignore)
    write_atomically(picture, drawn)


def print_found(console: Console, found: FoundTable) -> None:
    """Prints the table, the workspace and the region, each on a line."""
    grid, outline = found.calibration.grid, found.calibration.outline
    x, y = found.extent
    region = found.calibration.region
    covered = 100.0 if region is None else 100 * float(region.mean())
    lines = [
        f"table      z {grid.z_min:.4f} m, tilted by {math.degrees(found.tilt):.2f} degrees, "
        f"{x:.2f} x {y:.2f} m in view",
        f"workspace  x {grid.x_min:.3f} to {grid.x_max:.3f}, y {grid.y_min:+.3f} to "
        f"{grid.y_max:+.3f} m, {grid.rows} x {grid.cols} pixels: {found.chosen}",
        f"region     {len(outline.region)} corners, {covered:.0f} % of the workspace"
        + (
            f"; {len(outline.ignore)} areas with tall objects are ignored" if outline.ignore else ""
        ),
    ]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if found.tilt > MOST_TILT:
        console.print(
            f"The table is tilted by more than {math.degrees(MOST_TILT):.1f} degrees, which decide "
            "refuses: correct the pose with --check first",
            highlight=False,
            style="yellow",
            soft_wrap=True,
        )


def _table(table: TableCheck) -> dict[str, Any]:
    return {
        "tilt_deg": round(math.degrees(table.tilt_angle), 4),
        "tilt_about_x_deg": round(math.degrees(table.tilt[0]), 4),
        "tilt_about_y_deg": round(math.degrees(table.tilt[1]), 4),
        "height_bias_mm": _mm(table.bias),
        "noise_mm": _mm(table.noise),
        "holes_percent": round(100 * table.holes, 2),
    }


def _mm(metres: float) -> float:
    return round(1e3 * float(metres), 3)
