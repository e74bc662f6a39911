"""Tests a kit in simulation before it is made, with random errors of the printer."""

import base64
import html
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically, write_json
from kitting_drake.common.processes import LocalWorkers, ProcessCrashed, side_by_side
from kitting_drake.common.rendering import add_picture_renderer, png_bytes, render_picture
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.scenario.choosing import find_scenario

TOLERANCE_MM = 0.1
"""The standard deviation of the random error of the clearances, in mm on each side."""
_OFF = "wrong height or heading"
_TIGHT = ("insertion blocked", "misplaced", _OFF)
"""The causes of failures that a wider cavity may prevent."""
GOOD = 0.95
"""A kit fits if at least this share of the tools is kitted."""
_CLEARLY = 3
"""The test of a clearance ends early only after at least this many failures."""
_WIDER = (1.5, 2.25)
"""Clearances that are tried for a kit that does not fit, as multiples of the kit's own
clearance."""
_LEAST_WIDER_MM = 0.2
_FILES = ("proof.html", "proof.json")

_PAGE = """<!doctype html><meta charset="utf-8"><title>Proof of a kit</title>
<style>
body {{ font: 15px/1.45 sans-serif; max-width: 880px; margin: 2em auto; color: #222 }}
table {{ border-collapse: collapse }}
td, th {{ padding: .25em 1em .25em 0; text-align: left; border-bottom: 1px solid #ddd }}
h2 {{ font-size: 1.1em }}
@media print {{ body {{ margin: 0 }} }}
</style>
<h1>Proof of a kit</h1>
<p><strong>{verdict}</strong></p>
<p>In each simulated episode the tools lie elsewhere on the table, and all cavities are wider or
narrower by a random error with a standard deviation of {tolerance:g} mm. A tool counts as kitted if
its ADD-S is below 3.5 mm, its height error within 2 mm, and its heading error within 20 degrees.
The largest force is that of all contacts on the hand while it handled the tool.</p>
<p>{kit}</p><p>{pictures}</p>
{tables}
"""

Progress = Callable[[str, int, int], None]
"""A function that is called with a description of the test, the number of episodes done, and their
total number."""


@dataclass
class ToolProof:
    """The results of one tool, over all episodes."""

    name: str
    kitted: int = 0
    tried: int = 0
    peak_force_n: float = 0.0
    causes: Counter[str] = field(default_factory=Counter)
    """The number of failures by cause; the causes are named as in `results.json`."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the results as plain values for JSON."""
        return {
            "name": self.name,
            "kitted": self.kitted,
            "tried": self.tried,
            "peak_force_n": round(self.peak_force_n, 1),
            "causes": dict(self.causes),
        }


@dataclass
class _Outcome:
    """The results of one episode."""

    tools: list[ToolProof] = field(default_factory=list)
    pictures: list[bytes] = field(default_factory=list)
    """Pictures of the start and the end as PNG, if they were drawn."""
    failure: str | None = None
    """Why the episode failed; None if it did not."""


@dataclass
class KitProof:
    """The results of all episodes with one clearance."""

    clearance_mm: float
    tools: dict[str, ToolProof] = field(default_factory=dict)
    pictures: list[bytes] = field(default_factory=list)
    """Pictures of the start and the end of the first episode, as PNG."""
    episodes: int = 0
    """The number of episodes counted."""

    @property
    def kitted(self) -> int:
        """The number of strict successes of all tools in all episodes."""
        return sum(tool.kitted for tool in self.tools.values())

    @property
    def tried(self) -> int:
        """The number of tools times the number of episodes."""
        return sum(tool.tried for tool in self.tools.values())

    @property
    def fits(self) -> bool:
        """Whether the share of kitted tools reaches `GOOD`."""
        return self.kitted >= GOOD * self.tried

    @property
    def is_hopeless(self) -> bool:
        """Whether so many tools failed that the kit certainly does not fit."""
        if self.tried - self.kitted < _CLEARLY:
            return False
        return proportion_interval(self.kitted, self.tried)[1] < GOOD

    def add(self, outcome: _Outcome) -> None:
        """Adds the results of an episode."""
        self.episodes += 1
        self.pictures = self.pictures or outcome.pictures
        for item in outcome.tools:
            tool = self.tools.setdefault(item.name, ToolProof(item.name))
            tool.kitted += item.kitted
            tool.tried += item.tried
            tool.peak_force_n = max(tool.peak_force_n, item.peak_force_n)
            tool.causes += item.causes

    @property
    def may_be_tight(self) -> bool:
        """Whether the kit does not fit, but would if the failures with a cause in `_TIGHT` were
        successes."""
        stuck = sum(tool.causes[cause] for tool in self.tools.values() for cause in _TIGHT)
        return not self.fits and self.kitted + stuck >= GOOD * self.tried


def prove_kit(
    folder: Path,
    episodes: int,
    progress: Progress,
    *,
    tools: Sequence[str] = (),
    workers: int = 1,
) -> str:
    """Lets a policy fill a kit in simulation, and writes `proof.html` and `proof.json` into its
    folder.

    The policy is that of the kit's scenario. In each episode the tools lie at other poses. All
    cavities are wider or narrower by the same random error, with the standard deviation
    `TOLERANCE_MM`. A kit that does not fit is tried again with wider cavities, if these may
    prevent its failures. A clearance at which the kit certainly does not fit gets no further
    episodes.

    Args:
        folder: a folder that `hkd kit` wrote.
        episodes: the number of simulated episodes with each clearance.
        progress: a function that is called before the first and after each episode.
        tools: names or folders of the tools to put into the cavities, one for each cavity; by
            default the tools for which the cavities were made.
        workers: the number of processes that run episodes.

    Returns:
        The verdict, in a sentence or two.

    Raises:
        UserError: the simulation failed, for example because the table has no room for the kit and
            its tools.
    """
    record = json.loads((folder / "kit.json").read_text())
    own = 1e3 * float(record["kit_parameters_m"]["clearance"])
    fits = dict(record["kit_parameters_m"].get("clearance_of", {}))
    cavities = [tool["path"] for tool in record["tools"]]
    task: dict[str, Any] = {"tools": list(tools), "cavities": cavities} if tools else {}
    with LocalWorkers(min(workers, episodes)) as processes:
        proof = _prove(folder, own, episodes, progress, fits, task, processes)
        wider: list[KitProof] = []
        for factor in _WIDER if proof.may_be_tight else ():
            clearance = round(max(factor * own, own + _LEAST_WIDER_MM * (len(wider) + 1)), 2)
            more = {name: value + 1e-3 * (clearance - own) for name, value in fits.items()}
            wider.append(_prove(folder, clearance, episodes, progress, more, task, processes))
            if wider[-1].fits:
                break
    verdict = _verdict(proof, wider)
    # Record the files before writing them: `hkd kit` replaces only recorded files.
    record["files"] = sorted({*record["files"], *_FILES})
    write_json(folder / "kit.json", record)
    write_json(
        folder / "proof.json",
        {
            "verdict": verdict,
            "tolerance_mm": TOLERANCE_MM,
            "proved_with": list(tools) or cavities,
            "clearances": [
                {
                    "clearance_mm": item.clearance_mm,
                    "kitted": item.kitted,
                    "tried": item.tried,
                    "tools": [tool.as_dict() for tool in item.tools.values()],
                }
                for item in (proof, *wider)
            ],
        },
    )
    write_atomically(folder / "proof.html", _page(folder, proof, wider, verdict))
    return verdict


def _prove(
    folder: Path,
    clearance_mm: float,
    episodes: int,
    progress: Progress,
    clearance_of: Mapping[str, float],
    task: Mapping[str, Any],
    workers: LocalWorkers,
) -> KitProof:
    proof, queue = KitProof(clearance_mm), iter(range(episodes))
    waiting: dict[int, _Outcome] = {}
    what = f"clearance {clearance_mm:g} mm"

    def draw() -> tuple[int, str] | None:
        seed = None if proof.is_hopeless else next(queue, None)
        if seed is None:
            return None
        kit = _drawn_kit(seed, clearance_mm, clearance_of)
        return seed, json.dumps({"task": {**task, "kit": kit}})

    def run(item: tuple[int, str]) -> tuple[int, _Outcome | ProcessCrashed]:
        return item[0], workers.run(_run_episode, folder, *item)

    progress(what, 0, episodes)
    for ended, (seed, outcome) in enumerate(side_by_side(run, draw, workers=workers), start=1):
        if isinstance(outcome, ProcessCrashed):
            raise UserError(f"the simulation of the kit ended with exit code {outcome.exit_code}")
        if outcome.failure:
            raise UserError(f"the simulation of the kit failed: {outcome.failure}")
        waiting[seed] = outcome
        # Count the episodes in order, so that the result does not depend on which ends first.
        while proof.episodes in waiting and not proof.is_hopeless:
            proof.add(waiting.pop(proof.episodes))
        progress(what, ended, episodes)
    return proof


def _drawn_kit(seed: int, clearance_mm: float, clearance_of: Mapping[str, float]) -> dict[str, Any]:
    """Draws random clearances for an episode, as fields of a scenario's `kit`."""
    error = float(np.random.default_rng([seed, 23]).normal(0.0, TOLERANCE_MM))
    drawn = {
        name: round(max(value + 1e-3 * error, 0.0), 6)
        for name, value in {"": 1e-3 * clearance_mm, **clearance_of}.items()
    }
    kit: dict[str, Any] = {"clearance": drawn.pop("")}
    if drawn:
        kit["clearance_of"] = drawn
    return kit


def _run_episode(folder: Path, seed: int, text: str) -> _Outcome:
    """Runs one episode of a kit. The episode of seed 0 takes pictures."""
    try:
        chosen = find_scenario(folder / "scenario.yaml", None, text, None)
        diagram, station = build_chosen(chosen, seed=seed)
    except UserError as error:
        return _Outcome(failure=str(error))
    frames: list[bytes] = []

    def observe(event: Any) -> None:
        if not frames or event.is_stop:
            context = station.scene_graph.GetMyContextFromRoot(event.root_context)
            picture = render_picture(station.scene_graph, context, station.X_WOverview)
            frames.append(png_bytes(picture))

    pictured = seed == 0
    if pictured:
        add_picture_renderer(station.scene_graph)
    result = run_chosen(chosen, diagram, station, observers=[observe] if pictured else [])
    tools: dict[str, ToolProof] = {}
    for item in result.objects:
        tool = tools.setdefault(item.name, ToolProof(item.name))
        tool.tried += 1
        tool.kitted += item.strict_success
        if not item.strict_success:
            tool.causes[item.cause or _OFF] += 1
    for action in result.actions_taken:
        force = action.peak_force_n
        if action.object in tools and force is not None:
            tool = tools[action.object]
            tool.peak_force_n = max(tool.peak_force_n, force.vertical, force.lateral)
    return _Outcome(list(tools.values()), [frames[0], frames[-1]] if frames else [], result.failure)


def _verdict(proof: KitProof, wider: list[KitProof]) -> str:
    counted = (
        f"{proof.kitted} of {proof.tried} tools were kitted at {proof.clearance_mm:g} mm a side"
    )
    force = max((tool.peak_force_n for tool in proof.tools.values()), default=0.0)
    if proof.fits:
        return f"The kit fits: {counted}, with at most {force:.0f} N."
    worst = min(proof.tools.values(), key=lambda tool: tool.kitted / max(tool.tried, 1))
    trouble = (
        f"the worst tool is {worst.name} ({worst.tried - worst.kitted} of {worst.tried} failed"
    )
    if worst.causes:
        trouble += f", mostly {worst.causes.most_common(1)[0][0]}"
    cure = next((item for item in wider if item.fits), None)
    if not wider:
        advice = "Wider cavities would not help."
        if worst.causes["slipped"]:
            advice += (
                f" The {worst.name} slips from the hand: if the tool is lighter than its tool.yaml "
                "says, make it again with --mass_g; otherwise the hand has no good grasp of it."
            )
    elif cure is None:
        tried = " or ".join(f"{item.clearance_mm:g}" for item in wider)
        advice = f"A clearance of {tried} mm is not enough either."
    else:
        advice = (
            f"A clearance of {cure.clearance_mm:g} mm would be enough: "
            f"{cure.kitted} of {cure.tried} tools were kitted."
        )
    return f"The kit does not fit well: {counted}; {trouble}). {advice}"


def _page(folder: Path, proof: KitProof, wider: list[KitProof], verdict: str) -> str:
    """The proof as an HTML page that needs no other file."""

    def picture(data: bytes, width: int) -> str:
        encoded = base64.b64encode(data).decode()
        return f'<img width="{width}" src="data:image/png;base64,{encoded}">'

    pictures = [picture(data, 420) for data in proof.pictures]
    tables = []
    for item in (proof, *wider):
        low, high = proportion_interval(item.kitted, item.tried)
        rows = ""
        for tool in item.tools.values():
            causes = ", ".join(f"{why} {count}" for why, count in tool.causes.items())
            cells = (
                tool.name,
                f"{tool.kitted} of {tool.tried}",
                f"{tool.peak_force_n:.0f} N",
                causes,
            )
            rows += f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}</tr>"
        tables.append(
            f"<h2>{item.clearance_mm:g} mm a side: {item.kitted} of {item.tried} "
            f"({100 * low:.0f} to {100 * high:.0f} %)</h2><table><tr><th>tool</th><th>kitted</th>"
            f"<th>largest force</th><th>failures</th></tr>{rows}</table>"
        )
    return _PAGE.format(
        verdict=html.escape(verdict),
        tolerance=TOLERANCE_MM,
        kit=picture((folder / "kit.png").read_bytes(), 860),
        pictures=" ".join(pictures),
        tables="".join(tables),
    )
