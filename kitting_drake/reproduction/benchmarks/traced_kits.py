"""Traces cavities from rendered photos, and fills the kits with the true tools (`benchmark
traced_kits`)."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import append_line, claim_folder, read_lines
from kitting_drake.common.processes import counting_bar
from kitting_drake.common.provenance import commit, versions
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.evaluation.quantities import numbers_table
from kitting_drake.evaluation.summary import counted_objects, peak_forces
from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.kit_request import FITS, KitRequest
from kitting_drake.hkd.tools.tool import load_tool
from kitting_drake.hkd.tracing.command import import_traced
from kitting_drake.hkd.tracing.tracer import TraceRequest, trace
from kitting_drake.reproduction.benchmarks.trace_benchmark import TOOLS, drawn_case, write_photos
from kitting_drake.scenario.choosing import find_scenario

_PHOTOS = 6
"""The largest number of scenes of a tool. Another scene is photographed if the tracer refuses the
photos or doubts the outline."""
_TOOLS = 4
_LINES = "kits.jsonl"


def measure_traced_kits(
    kits: int, seed: int, fit: str, shots: int, folder: Path, console: Console
) -> dict[str, Any]:
    """Makes kits of four tools from traced photos, and lets the oracle fill them with the true
    tools, with one try for each tool. Skips the kits that are in the folder already.

    The photos are rendered as for `benchmark trace`, with each tool's own height. With one photo of
    a scene, the tracer is given this height, else it finds it. If the tracer refuses the photos or
    doubts the outline, photos of another scene are taken.

    Args:
        kits: the number of kits.
        seed: the seed of photos and scenes.
        fit: the kits' clearance, a key of `FITS`.
        shots: the number of photos of each scene, from different sides.
        folder: the folder of `kits.jsonl`, photos and kits.
        console: the console for the progress.

    Raises:
        UserError: the folder holds other files, or the kits of another version.
    """
    identity = {"seed": seed, "fit": fit, "shots": shots, "versions": versions()}
    claim_folder(folder, "kits_of.json", identity, of="seed, fit, number of photos or version")
    done = {line["kit"]: line for line in read_lines(folder / _LINES)}
    with counting_bar(console, "kits") as progress:
        bar = progress.add_task("", total=kits)
        for number in range(kits):
            if number not in done:
                done[number] = _measure(number, seed, FITS[fit], shots, folder / f"kit_{number}")
                append_line(folder / _LINES, done[number])
            progress.advance(bar)
    return {**identity, "commit": commit(), **_summary([done[number] for number in range(kits)])}


def _measure(
    number: int, seed: int, clearance_mm: float, shots: int, folder: Path
) -> dict[str, Any]:
    """Makes one kit and fills it."""
    photos: list[dict[str, Any]] = []
    traced = {
        name: _traced(name, _TOOLS * number + slot, seed, shots, folder / name, photos)
        for slot, name in enumerate(_names(number, seed))
    }
    names = [name for name, place in traced.items() if place is not None]
    cavities = [str(place.resolve()) for place in traced.values() if place is not None]
    if not names:
        raise UserError("the tracer refuses or doubts all photos of a kit: take another --seed")
    export_kit(KitRequest(tuple(cavities), folder / "kit", clearance_mm=clearance_mm))
    task = json.dumps({"tools": names, "cavities": cavities, "tries": 1})
    chosen = find_scenario(
        folder / "kit" / "scenario.yaml", text=f"{{task: {task}, policy: !Oracle {{}}}}"
    )
    result = run_chosen(chosen, *build_chosen(chosen, seed=seed + number))
    if result.interrupted:
        raise KeyboardInterrupt
    left_out = [name for name, place in traced.items() if place is None]
    return {"kit": number, "photos": photos, "left_out": left_out, "episode": result.as_dict()}


def _names(number: int, seed: int) -> list[str]:
    """Returns the tools of a kit. All tools are used once before one is used again."""
    round_, place = divmod(_TOOLS * number, len(TOOLS))
    mixed = np.random.default_rng([seed, round_]).permutation(len(TOOLS))
    return [TOOLS[index] for index in mixed[place : place + _TOOLS]]


def _traced(
    name: str, index: int, seed: int, shots: int, folder: Path, photos: list[dict[str, Any]]
) -> Path | None:
    """Traces a tool, and appends its scenes to `photos`.

    Returns:
        The folder of the traced tool; None if the tracer refuses all photos or doubts their
        outlines.
    """
    true = load_tool(name)
    for attempt in range(_PHOTOS):
        spec, drawn = drawn_case(name, _PHOTOS * index + attempt, attempt % 3, True, seed)
        drawn = dataclasses.replace(drawn, height=1e3 * true.height)
        place = folder / f"photo_{attempt}"
        place.mkdir(parents=True, exist_ok=True)
        entry: dict[str, Any] = {"tool": name, "tilt_deg": spec.tilt, "ground": spec.ground}
        photos.append(entry)
        taken = write_photos(place, spec, drawn, shots)
        heights = (drawn.height,) if shots == 1 else ()
        request = TraceRequest(taken, place, heights_mm=heights, name=name)
        try:
            report = trace(request)
        except UserError as error:
            entry["refused"] = str(error)
            continue
        traced = max(report.tools, key=lambda tool: tool.outline.area())
        entry["doubts"] = sum(len(tool.doubts) for tool in report.tools)
        entry["height_error_mm"] = (traced.height_mm or 0.0) - drawn.height
        if not entry["doubts"]:
            place = folder / "tools"
            return import_traced(traced, true.category, f"traced_{name}", place).directory
    return None


def _summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    episodes = [line["episode"] for line in lines]
    objects = [item for items in counted_objects(episodes) for item in items]
    strict = sum(item["strict_success"] for item in objects)
    photos = [photo for line in lines for photo in line["photos"]]
    forces = [peak["force"] for peak in peak_forces(episodes)]
    return {
        "kits": len(lines),
        "tools": len(objects),
        "left_out": sum(len(line["left_out"]) for line in lines),
        "strict": strict,
        "interval": proportion_interval(strict, len(objects)),
        "failed": {
            item["name"]: item["cause"] or "wrong height or heading"
            for item in objects
            if not item["strict_success"]
        },
        "photos": len(photos),
        "photos_in_doubt": sum(bool(photo.get("doubts")) for photo in photos),
        "photos_refused": sum("refused" in photo for photo in photos),
        "peak_force_n": max(forces, default=None),
        "height_error_mm": max(
            (abs(photo["height_error_mm"]) for photo in photos if photo.get("doubts") == 0),
            default=None,
        ),
    }


def traced_kits_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the measurements."""
    table = numbers_table(f"{measured['kits']} traced kits, fit: {measured['fit']}", "", "measured")
    low, high = measured["interval"]
    table.add_row("strict successes", f"{measured['strict']} of {measured['tools']}")
    table.add_row("95 % interval, %", f"{100 * low:.0f} to {100 * high:.0f}")
    table.add_row("tools left out: all scenes in doubt", str(measured["left_out"]))
    table.add_row(
        "scenes photographed; in doubt, refused",
        f"{measured['photos']}; {measured['photos_in_doubt']}, {measured['photos_refused']}",
    )
    if measured["peak_force_n"] is not None:
        table.add_row("largest force, N", f"{measured['peak_force_n']:.0f}")
    if measured["shots"] > 1 and measured["height_error_mm"] is not None:
        table.add_row("largest error of a height, mm", f"{measured['height_error_mm']:.1f}")
    for name, cause in measured["failed"].items():
        table.add_row(f"failed: {name}", cause)
    return table
