"""Writes how the cells "as in the paper" differ from the paper, and the effect of each
difference."""

from __future__ import annotations

from collections.abc import Mapping

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.paired import OWN, paired_difference, points_text
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import has_unlimited_hand
from kitting_drake.reproduction.paper.cell_results import Result
from kitting_drake.reproduction.paper.cells import PRESET
from kitting_drake.reproduction.paper.failed_grasps import changeable, is_as_in_the_paper

_NOT_MEASURED = (
    ("physics and cameras", "another simulator", "Drake: hydroelastic contact, rendered cameras"),
    ("speed of the floating hand", "not given", "faster than an arm could move it"),
    ("rim of a cavity", "not given", "a lead-in bevel of 1 mm"),
    ("friction of a kit", "not given", "0.3"),
    (
        "poses in a scene",
        "not given",
        "drawn until the open hand has room at every annotated grasp",
    ),
    (
        "fingers, on the pyramid",
        "not given",
        "15 mm thick, but cubes are 10 mm apart: jaws that open along a row push the next cube",
    ),
    ("release, in cells marked `e`", "the jaws open by 5 mm", "the jaws open by 12 mm"),
    ("jaws before a pick, in cells marked `e`", "50 mm apart (place red in green)", "80 mm apart"),
    (
        "demonstrated picks, in cells marked `e`",
        "off the object's middle, along one axis",
        "at the object's middle",
    ),
    (
        "size of the networks",
        "as given (preset `paper`)",
        f"preset `{PRESET}`: our networks have 1/25 of the parameters, the Transporter's 1/70",
    ),
    ("labels", "one pixel and orientation", "shared among neighbouring pixels and orientations"),
    (
        "search for a place",
        "one correlation",
        "a correlation at half the resolution, with its own loss; then a full one near its maxima",
    ),
    (
        "random shift of training scenes",
        "not given",
        "standard deviation: a sixth of each side of the image (Ravens: of its shorter side)",
    ),
    ("classes of alpha", "the pixels", 'the pixels and "nothing to pick"'),
    ("checkpoint", "the best on the test runs", "the best on separate validation scenes"),
    (
        "the Transporter's rotations",
        "all 36 in a training step",
        "5 of 36 in a training step: the right one and random others",
    ),
    (
        "learning rate",
        "0.0001 for every method",
        "0.001 for our method, the best of three for each baseline",
    ),
)
"""The differences whose effect was not measured: name, the paper's or Ravens' way, and ours."""


def departures(results: Mapping[str, Result]) -> str:
    """Writes the section on departures from the paper, with its two tables.

    Args:
        results: the results by the names of their cells.
    """
    measured = [
        (
            "training steps",
            "10,000, at one learning rate",
            "1000 to 3000; the learning rate rises, then falls",
            _compared(
                results,
                "success of our method with three times the steps",
                {
                    f"{label}, N = {n}": (f"{name}_3_times_the_steps", name)
                    for label, task, count in (
                        ("pyramid", "stack_block_pyramid", 100),
                        ("place red in green, one demonstration", "place_red_in_green", 1),
                    )
                    for n in (180, 36)
                    for name in (f"{task}_so2_{n}_{count}",)
                },
            ),
        ),
        (
            "networks that do not depend on N",
            "trained at each N",
            "trained once, at N = 180",
            _compared(
                results,
                "success if trained at N = 36",
                {
                    label: (f"{name}_trained_at_36", name)
                    for label, name in (
                        ("ours, unseen", "unseen_so2_36_100"),
                        ("ours, seen", "seen_so2_36_100"),
                        (
                            "Equivariant Transporter, unseen",
                            "unseen_equivariant_transporter_36_100",
                        ),
                    )
                },
            ),
        ),
        (
            "a baseline's pick-angle network",
            "0.90 M parameters at N = 36",
            "10.8 k",
            _compared(
                results,
                "success with 103 k, as many as ours",
                {
                    "Equivariant Transporter, unseen, N = 36": (
                        "unseen_equivariant_transporter_36_100_every_chance",
                        "unseen_equivariant_transporter_36_100",
                    )
                },
            ),
        ),
        (
            "memory of failed grasps",
            "none",
            "no pick within 10 mm of a failed grasp of the same episode",
            _memory(results),
        ),
    ]
    headings = ["what", "in the paper", "here"]
    with_effect = markdown_table([*headings, "effect"], measured, left_columns=4)
    without = markdown_table(headings, _NOT_MEASURED, left_columns=3)
    measured_text = f"{prose('departures')}\n{with_effect}"
    others_text = f"{prose('departures_not_measured')}\n{without}"
    return f"{measured_text}\n{others_text}{_earlier_hand(results)}"


def _compared(
    results: Mapping[str, Result], what: str, pairs: Mapping[str, tuple[str, str]]
) -> str:
    """Writes the difference of each pair of cells in the paper's measure, in percentage points.

    Pairs without results are left out.
    """
    found = []
    for label, (one, other) in pairs.items():
        if one in results and other in results:
            points = paired_difference(results[one].summary, results[other].summary, OWN)
            if points is not None:
                found.append(f"{label}: {points_text(points)} points")
    return f"{what}:<br>{'<br>'.join(found)}" if found else "not yet measured"


def _earlier_hand(results: Mapping[str, Result]) -> str:
    """Writes a paragraph on the cells that were run without limits on contact forces, if there are
    any."""
    found = [has_unlimited_hand(item.summary["resolved_scenario"]) for item in results.values()]
    if not any(found):
        return ""
    some = "all" if all(found) else f"{sum(found)} of the"
    return f"\n{prose('unlimited_hand', cells=f'{some} {len(found)} cells')}"


def _memory(results: Mapping[str, Result]) -> str:
    """Writes, for kitting and for Ravens tasks, the percentage of the actions that the memory of
    failed grasps can have changed."""
    parts = []
    for label, is_kitting in (("kitting", True), ("Ravens", False)):
        found = [
            changeable(result.summary)
            for result in results.values()
            if is_as_in_the_paper(result) and (result.cell.task in ("seen", "unseen")) == is_kitting
        ]
        if found:
            total = sum(found[1:], found[0])
            least, most = (100 * count / total.actions for count in (total.at_least, total.at_most))
            parts.append(f"{label}: {least:.1f} to {most:.1f} %")
    return f"actions possibly changed:<br>{'<br>'.join(parts)}" if parts else "not yet measured"
