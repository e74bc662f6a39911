"""Writes the section on how much better one method is than another on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.paired import (
    OWN,
    STRICT,
    mean_paired_difference,
    paired_difference,
    points_text,
)
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result
from kitting_drake.reproduction.paper.cells import ORIENTATIONS, Cell, Training
from kitting_drake.reproduction.paper.paper_tables import (
    AT_FASTER,
    DEMONSTRATIONS,
    EVERY_CHANCE,
    FIGURE_6,
    HEADLINE_SEEDS,
    PATIENT,
    SHIPPED,
    headline,
)


def differences(results: Mapping[str, Result]) -> list[str]:
    """Writes the section on paired differences; it is empty if no two cells can be compared."""
    rows = []
    for name, result in results.items():
        for label, other in _rivals(result.cell):
            if other not in results:
                continue
            pair = (result.summary, results[other].summary)
            found = [paired_difference(*pair, rate) for rate in (STRICT, OWN)]
            if any(item is None for item in found):
                continue
            rows.append([name, label, *(points_text(item) for item in found if item is not None)])
    rows += _means(results)
    if not rows:
        return []
    return [
        "### Paired differences\n",
        prose("differences"),
        markdown_table(
            ["cell", "compared with", "strict", "paper's measure"], rows, left_columns=2
        ),
    ]


def _means(results: Mapping[str, Result]) -> list[list[str]]:
    """Returns rows with mean differences between SO(2) and the Equivariant Transporter.

    For each task and number of demonstrations in figure 6, a row has the mean over N, if both
    methods have results at every N. For each task, another row has the mean over the training seeds
    for which both methods have results, if there are several.
    """
    rows = []
    ours, theirs = LEARNED[:2]
    for task in FIGURE_6:
        for count in DEMONSTRATIONS:
            names = [[f"{task}_{m}_{n}_{count}" for m in (ours, theirs)] for n in ORIENTATIONS]
            if all(name in results for pair in names for name in pair):
                label = f"{task}, {count} demonstrations, mean over N"
                rows.append(_mean_row(results, label, names))
        trained = [
            [headline(task, m, seed).name for m in (ours, theirs)] for seed in HEADLINE_SEEDS
        ]
        trained = [pair for pair in trained if all(name in results for name in pair)]
        if len(trained) > 1:
            label = f"{task}, N = 180, mean over {len(trained)} trainings"
            rows.append(_mean_row(results, label, trained))
    return rows


def _mean_row(
    results: Mapping[str, Result], label: str, names: Sequence[Sequence[str]]
) -> list[str]:
    """Returns a row with `label` and the mean difference over pairs of cells."""
    pairs = [(results[one].summary, results[two].summary) for one, two in names]
    found = [mean_paired_difference(pairs, rate) for rate in (STRICT, OWN)]
    texts = [points_text(item) for item in found if item is not None]
    return [label, METHODS[LEARNED[1]], *texts]


def _rivals(cell: Cell) -> list[tuple[str, str]]:
    """Returns the labels and names of the cells with which a cell is compared."""
    training = cell.policy
    if cell.label == "trained_at_36" and isinstance(training, Training):
        return [("trained at N = 180", f"{cell.task}_{training.method}_36_100")]
    if cell.label.startswith(PATIENT) and isinstance(training, Training):
        tail = f"{training.method}_{cell.orientations}_{training.demonstrations}"
        return [("the usual number of steps", f"{cell.task}_{tail}{cell.label[len(PATIENT) :]}")]
    if cell.label == AT_FASTER and isinstance(training, Training):
        tail = f"{cell.orientations}_{training.demonstrations}"
        return [
            ("its own learning rate", f"{cell.task}_so2_{tail}"),
            *((METHODS[other], f"{cell.task}_{other}_{tail}") for other in LEARNED[1:]),
        ]
    if cell.label == EVERY_CHANCE and isinstance(training, Training):
        tail = f"{cell.orientations}_{training.demonstrations}"
        return [
            ("as in the paper", f"{cell.task}_{training.method}_{tail}"),
            (METHODS[LEARNED[0]], f"{cell.task}_{LEARNED[0]}_{tail}"),
        ]
    if cell.label == "generalist":
        others = [label for label in SHIPPED if label != cell.label]
        return [
            (label.replace("_", " ").replace("of 100", "trained on 100"), f"{cell.task}_{label}")
            for label in others
        ]
    if not isinstance(training, Training) or training.method != "so2":
        return []
    if cell.label.startswith("minus"):
        return [("ours, with all extensions", f"{cell.task}_so2_180_100_ours")]
    if cell.label == "ours_recovering":
        return [("one try per tool", f"{cell.task}_so2_180_100_ours")]
    tail = f"{cell.orientations}_{training.demonstrations}"
    if cell.label:
        return [("ours, as in the paper", f"{cell.task}_so2_{tail}")]
    tail += f"_seed{training.seed}" if training.seed else ""
    return [
        *((METHODS[other], f"{cell.task}_{other}_{tail}") for other in LEARNED[1:]),
        (METHODS["quantized_oracle"], f"{cell.task}_quantized_oracle_{cell.orientations}"),
    ]
