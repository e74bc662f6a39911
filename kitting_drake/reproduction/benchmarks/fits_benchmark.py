"""Measures strict success and peak force against the clearance of the cavities (`benchmark fits`).

Shape matching places four tools into cavities with 2 to 0.3 mm of clearance on each side. It does
so with perfect and with moderate sensing, and with and without the hand's search after a blocked
insertion.
"""

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from kitting_drake.common.files import append_line, claim_folder, read_lines
from kitting_drake.common.processes import counting_bar
from kitting_drake.common.provenance import commit, versions
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.evaluation.summary import Episode, counted_objects, peak_forces
from kitting_drake.scenario.choosing import ChosenScenario, find_scenario

CLEARANCES_MM = (2.0, 1.0, 0.5, 0.3)
SENSING = {"perfect": None, "moderate": "calibration:moderate,depth_noise:moderate"}
"""The kinds of sensing by name, and the perturbations of each."""

_SCENARIO = Path("scenarios/kitting_oracle.yaml")
_WITHOUT_SEARCH = "search: {amplitude: 0.0, reach: 0.0}"
_LINES = "episodes.jsonl"


@dataclass(frozen=True)
class Fit:
    """The conditions of an episode: clearance, sensing and search."""

    clearance_mm: float
    sensing: str
    """The kind of sensing, a key of `SENSING`."""
    search: bool
    """Whether the hand searches for the cavity after a blocked insertion."""

    def choose(self) -> ChosenScenario:
        """Returns the scenario with these conditions."""
        planner = "" if self.search else f", planner: {{{_WITHOUT_SEARCH}}}"
        text = (
            f"{{task: {{kit: {{clearance: {self.clearance_mm / 1e3:g}}}}}, "
            f"policy: !ShapeMatching {{}}{planner}}}"
        )
        return find_scenario(_SCENARIO, text=text, perturb=SENSING[self.sensing])


FITS = [
    Fit(clearance, sensing, search)
    for search, sensing, clearance in itertools.product((True, False), SENSING, CLEARANCES_MM)
]


def measure_fits(
    episodes: int, seed: int, folder: Path, console: Console, fits: Sequence[Fit] = tuple(FITS)
) -> dict[str, Any]:
    """Runs the episodes of all conditions, seed by seed. Episodes that are in the folder already
    are skipped.

    Args:
        episodes: the number of episodes for each of the conditions.
        seed: the first of the successive seeds.
        folder: the folder of `episodes.jsonl`.
        console: the console for the progress.
        fits: the conditions.

    Returns:
        The commit, the seeds and the summary of each condition; see `summarize_fit`.

    Raises:
        UserError: the folder holds other files, or the episodes of another version.
    """
    claim_folder(
        folder,
        "fits_of.json",
        {"scenario": Fit(2.0, "perfect", True).choose().described, "versions": versions()},
        of="scenario or version",
    )
    lines = read_lines(folder / _LINES)
    done = {(Fit(**line["fit"]), line["episode"]["seed"]): line["episode"] for line in lines}
    seeds = range(seed, seed + episodes)
    wanted = list(itertools.product(seeds, fits))
    with counting_bar(console, "episodes") as progress:
        bar = progress.add_task("", total=len(wanted))
        for number, fit in wanted:
            if (fit, number) not in done:
                chosen = fit.choose()
                result = run_chosen(chosen, *build_chosen(chosen, seed=number))
                if result.interrupted:
                    raise KeyboardInterrupt
                done[fit, number] = result.as_dict()
                append_line(folder / _LINES, {"fit": asdict(fit), "episode": done[fit, number]})
            progress.advance(bar)
    return {
        "seeds": [seed, episodes],
        "commit": commit(),
        "fits": [summarize_fit(fit, [done[fit, number] for number in seeds]) for fit in fits],
    }


def summarize_fit(fit: Fit, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Summarizes the strict successes, causes of failure and forces of the episodes of one
    condition."""
    objects = [item for items in counted_objects(episodes) for item in items]
    strict = sum(item["strict_success"] for item in objects)
    forces = [peak["force"] for peak in peak_forces(episodes)]
    causes = Counter(
        item["cause"] or "sticks out or reversed" for item in objects if not item["strict_success"]
    )
    return {
        **asdict(fit),
        "tools": len(objects),
        "strict": strict,
        "interval": proportion_interval(strict, len(objects)),
        "causes": dict(causes.most_common()),
        "peak_force_n": {
            "median": float(np.median(forces)) if forces else None,
            "max": max(forces, default=None),
        },
        "stopped_actions": sum(episode["stopped_actions"] for episode in episodes),
        "wall_seconds": sum(episode["wall_seconds"] for episode in episodes),
    }


def fits_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the measurements, with a row for each condition."""
    table = Table(title="strict success against the clearance")
    for heading in ("clearance, mm", "sensing", "search"):
        table.add_column(heading)
    for heading in ("strict", "95 %", "peak force, N: median, most", "causes"):
        table.add_column(heading, justify="right")
    for found in measured["fits"]:
        low, high = found["interval"]
        force = found["peak_force_n"]
        peaks = "-" if force["max"] is None else f"{force['median']:.0f}, {force['max']:.0f}"
        table.add_row(
            f"{found['clearance_mm']:g}",
            found["sensing"],
            "on" if found["search"] else "off",
            f"{found['strict']}/{found['tools']}",
            f"{100 * low:.0f} to {100 * high:.0f}",
            peaks,
            ", ".join(f"{count} {cause}" for cause, count in found["causes"].items()) or "-",
        )
    return table
