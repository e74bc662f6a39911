"""Measures the building time, clearance and size of the dataset's kits (`benchmark kits`)."""

import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kitting_drake.evaluation.quantities import numbers_table
from kitting_drake.hkd.kits.block import build_block, contact_surfaces
from kitting_drake.hkd.kits.clearance import measure_clearance
from kitting_drake.hkd.kits.layout import kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import load_tool
from kitting_drake.hkd.tools.toolsets import PAPER_SPLITS, toolsets


def benchmark_kits(count: int | None, console: Console) -> dict[str, Any]:
    """Builds the dataset's kits; returns their measurements, in seconds and millimetres.

    Args:
        count: the number of kits of each split; None for all.
        console: the console for the progress.
    """
    build_times, triangles, medians, minima = [], [], [], []
    chosen = [names for split in PAPER_SPLITS for names in toolsets(split)[:count]]
    for names in track(chosen, "kits", console=console, transient=True, disable=console.quiet):
        start = time.perf_counter()
        # Bypass the cache, so that every kit is built from the meshes on disk.
        tools = [load_tool(name) for name in names]
        layout = layout_kit(tools, KitParameters())
        parameters = layout.parameters
        cavities = kit_cavities(tools, parameters, layout.poses)
        block = build_block(cavities, parameters)
        faces = sum(len(part) for _, part in contact_surfaces(cavities, parameters).values())
        build_times.append(time.perf_counter() - start)
        triangles.append(faces)
        for tool, pose in zip(tools, layout.poses, strict=True):
            clearance = measure_clearance(block, tool, parameters, pose)
            medians.append(1e3 * clearance.median)
            minima.append(1e3 * clearance.minimum)
    return {
        "kits": len(chosen),
        "build_s": {"median": float(np.median(build_times)), "max": max(build_times)},
        "contact_triangles": {"median": float(np.median(triangles)), "max": max(triangles)},
        "clearance_mm": {
            "smallest_median": min(medians),
            "median": float(np.median(medians)),
            "largest_median": max(medians),
            "minimum": min(minima),
        },
    }


def kits_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the measurements for the terminal."""
    table = numbers_table(f"{measured['kits']} kits, one core", "what", "measured")
    build, triangles = measured["build_s"], measured["contact_triangles"]
    clearance = measured["clearance_mm"]
    table.add_row("building, s: median, slowest", f"{build['median']:.2f}, {build['max']:.2f}")
    table.add_row(
        "triangles for the contact solver: median, most",
        f"{triangles['median']:.0f}, {triangles['max']}",
    )
    table.add_row(
        "clearance, mm: median along an outline, over all cavities",
        f"{clearance['smallest_median']:.2f} to {clearance['largest_median']:.2f}",
    )
    table.add_row("clearance, mm: least anywhere", f"{clearance['minimum']:.2f}")
    return table
