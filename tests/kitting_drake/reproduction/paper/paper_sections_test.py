"""The sections of docs/results.md and docs/protocol.md on the paper, made from synthetic runs."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.summary import summarise
from kitting_drake.reproduction.page.runs import Run, described
from kitting_drake.reproduction.paper.cell_results import Result, cell_results
from kitting_drake.reproduction.paper.cells import TASKS, Cell, Training
from kitting_drake.reproduction.paper.learning_rates import RATES, Rates, read_rates
from kitting_drake.reproduction.paper.paper_figures import draw_figure_6, draw_table_1
from kitting_drake.reproduction.paper.paper_sections import (
    flat_shapes_table,
    fresh_tools,
    has_figure,
    has_table_1,
    paper_sections,
)
from kitting_drake.reproduction.paper.paper_tables import paper_cells
from kitting_drake.reproduction.paper.protocol_sections import protocol_sections
from kitting_drake.scenario.loader import load_scenario
from tests.kitting_drake.evaluation.episodes import ADD_S, CHOSEN, make_episode

CELLS = {cell.name: cell for cell in paper_cells()}


def make_run(name: str, errors_mm: list[float]) -> Run:
    """A run of a cell. In every episode, the objects have the given errors."""
    cell: Cell = CELLS[name]
    task = TASKS[cell.task]
    scenario = load_scenario(SCENARIOS / task.file, task.tested, cell.scenario_text("w"))
    episodes = [make_episode(seed, errors_mm) for seed in cell.seeds]
    summary = summarise(episodes, CHOSEN, ADD_S, wall_seconds_total=1.0)
    details = {"orientations": cell.orientations, "method": "shape_matching"}
    if isinstance(cell.policy, Training):
        details |= {
            "method": cell.policy.method,
            "scenario": f"{Path(task.file).stem}:{task.demonstrated}",
            "preset": cell.policy.preset,
            "rotations": cell.policy.rotations,
            "trained_orientations": cell.policy.orientations,
            "angle_only": cell.policy.angle_only,
            "demonstrations": cell.policy.demonstrations,
            "training_seed": cell.policy.seed,
            "steps": cell.policy.steps,
            "learning_rate": cell.policy.learning_rate or 0.001,
            "decay": True,
            "continuous": cell.continuous,
            "fit_outlines": cell.fit_outlines,
            "recover": False,
            "taken_only": cell.policy.taken_only,
            "rigid": cell.policy.rigid,
        }
    summary |= {"resolved_scenario": described(scenario), "policy_details": details}
    # The checkout that runs the test may have uncommitted changes, which would exclude the run.
    summary["commit"] = "0123456789"
    if isinstance(cell.policy, str):
        summary["policy_digest"] = scenario.policy.digest(SCENARIOS / "paper")
    return Run(name, summary)


def sections(runs: Iterable[Run], rates: Rates | None = None) -> str:
    """The text of the sections of both pages."""
    divided = cell_results(list(runs), rates or {})
    results, again = divided.results, divided.to_run_again
    found = fresh_tools(results, again) + paper_sections(results, None, again)
    return "\n".join(found + protocol_sections(results, rates or {}, again))


@pytest.fixture(scope="module")
def runs() -> tuple[Run, ...]:
    return (
        make_run("unseen_so2_180_100", [1.0, 1.0, 1.0, 9.0]),
        make_run("unseen_so2_180_100_ours", [1.0, 1.0, 1.0, 1.0]),
        make_run("unseen_equivariant_transporter_180_100", [1.0, 1.0, 9.0, 9.0]),
        make_run("unseen_quantized_oracle_180", [1.0, 1.0, 1.0, 1.0]),
        make_run("stack_block_pyramid_so2_36_10", [1.0, 9.0]),
        make_run("fresh_shape_matching", [1.0, 1.0, 1.0, 1.0]),
    )


def rows(text: str) -> dict[tuple[str, ...], list[str]]:
    """The cells of each row of all tables, by the row's first two cells."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {tuple(row[:2]): row[2:] for row in cells}


def test_the_tables_show_cells_and_missing_ones(runs: tuple[Run, ...]):
    text = sections(runs)
    found = rows(text)
    assert found["SO(2)-equivariant (ours)", "100"] == ["-"] * 3 + ["75.0 (70.5 to 79.0) / 75.0"]
    assert found["Transporter", "100"] == ["-", "", "", ""]
    assert found["oracle, quantized", ""][-1].startswith("100.0")
    assert found["unseen_so2_180_100", "Equivariant Transporter"] == ["+25.0 (+25.0 to +25.0)"] * 2
    assert found["unseen_so2_180_100", "oracle, quantized"][0].startswith("-25.0")
    assert found["as in the paper", "75.0 (70.5 to 79.0) / 75.0"] == ["-"]
    assert found["with all extensions", "100.0 (99.0 to 100.0) / 100.0"] == ["-"]
    assert found["without outline fitting", "-"] == [""]
    every = text.split("### Every cell")[1]
    assert {row[0] for row in rows(every)} >= {run.name for run in runs}
    assert "misplaced 100" in every
    pyramid = [line for line in text.splitlines() if " 36 |" in line and " 10 |" in line]
    assert any("50.0 (43.1 to 56.9) / 84.5 |" in line for line in pyramid)
    assert found["shape matching", "100.0 (99.0 to 100.0)"][1] == "100.0 (99.0 to 100.0)"
    assert found["generalist", "-"] == ["-", "-"]


def test_prose_about_a_cell_appears_with_the_cell(runs: tuple[Run, ...]):
    told = {
        "palletizing_boxes_so2_180_1": "With one demonstration of palletizing",
        "palletizing_boxes_transporter_36_100": "All methods train for 3000 steps on palletizing",
        "stack_block_pyramid_so2_36_10_ours": "The pyramid, with two extensions",
    }
    rates, without = {"unseen_transporter": {"0.001": 1.0}}, sections(runs)
    everything = sections([*runs, *(make_run(name, [1.0, 9.0]) for name in told)], rates)
    for words in told.values():
        assert words in everything
        assert words not in without
    # All placeholders of the pages' templates were filled in.
    assert not set("{}$") & set(everything)
    assert "<!--" not in everything


def test_the_mean_over_n_needs_all_of_its_cells(runs: tuple[Run, ...]):
    more = list(runs)
    label = ("unseen, 100 demonstrations, mean over N", "Equivariant Transporter")
    for n in (36, 72, 120):
        more.append(make_run(f"unseen_so2_{n}_100", [1.0, 1.0, 9.0, 9.0]))
        assert label not in rows(sections(more))
        more.append(make_run(f"unseen_equivariant_transporter_{n}_100", [1.0, 1.0, 1.0, 1.0]))
    # The mean of the differences -50, -50, -50 and +25.
    assert rows(sections(more))[label] == ["-31.2 (-31.2 to -31.2)"] * 2


def test_trainings_are_compared_from_two_on(runs: tuple[Run, ...]):
    assert "Variation between trainings" not in sections(runs)
    more = [*runs, make_run("unseen_so2_180_100_seed2", [1.0, 1.0, 1.0, 1.0])]
    found = rows(sections(more))
    ours = found["SO(2)-equivariant (ours)", "unseen"]
    # The success rates of the two trainings are 75 % and 100 %.
    assert ours == ["75.0 / 75.0", "-", "100.0 / 100.0", "87.5 ± 17.7 / 87.5 ± 17.7"]
    assert ("Equivariant Transporter", "unseen") not in found
    theirs = "unseen_equivariant_transporter_180_100_seed2"
    more.append(make_run(theirs, [1.0, 1.0, 1.0, 9.0]))
    label = ("unseen, N = 180, mean over 2 trainings", "Equivariant Transporter")
    assert rows(sections(more))[label] == ["+25.0 (+25.0 to +25.0)"] * 2


def test_a_longer_training_is_compared_with_the_usual_one():
    ours = "stack_block_pyramid_so2_36_100"
    text = sections(
        [
            make_run(ours, [9.0, 9.0]),
            make_run(f"{ours}_ours", [1.0, 9.0]),
            make_run(f"{ours}_3_times_the_steps_ours", [1.0, 1.0]),
        ]
    )
    name = f"{ours}_3_times_the_steps_ours", "the usual number of steps"
    assert rows(text)[name][0] == "+50.0 (+50.0 to +50.0)"
    assert "| 100, 3 times the steps | 100.0" in text


def test_a_matched_baseline_is_compared_with_the_usual_one_and_with_ours():
    theirs = "unseen_transporter_36_100"
    text = sections(
        [
            make_run("unseen_so2_36_100", [1.0, 1.0, 1.0, 1.0]),
            make_run(theirs, [9.0, 9.0, 9.0, 9.0]),
            make_run(f"{theirs}_every_chance", [1.0, 1.0, 9.0, 9.0]),
        ]
    )
    found = rows(text)
    name = f"{theirs}_every_chance"
    assert found[name, "as in the paper"][0] == "+50.0 (+50.0 to +50.0)"
    assert found[name, "SO(2)-equivariant (ours)"][0] == "-50.0 (-50.0 to -50.0)"


def test_an_interval_over_tools_needs_drawn_tools():
    pair = [make_run(f"{task}_so2_180_100", [1.0, 1.0, 1.0, 1.0]) for task in ("seen", "unseen")]
    for run in pair:
        # An interval over tools needs at least three tools that fail, so let all objects of the
        # first episode fail.
        first = run.summary["outcomes"][0]
        first["objects"] = dict.fromkeys(first["objects"], 0)
    every = sections(pair).split("### Every cell")[1]
    cells = {row[0]: more for row, more in rows(every).items()}
    assert cells["seen_so2_180_100"][7] == "-"
    assert " to " in cells["unseen_so2_180_100"][7]


def test_the_tried_learning_rates_are_listed(runs: tuple[Run, ...]):
    rates = {
        "unseen_transporter": {"0.001": 4.0, "0.0003": 2.5, "0.01": math.inf},
        "stack_block_pyramid_transporter": {"0.001": 9.25, "0.0003": 12.0},
    }
    text = sections(runs, rates)
    assert (
        "- the Transporter, unseen: 0.0003, chosen from 0.001 (4.00 mm), 0.0003 (2.50 mm), "
        "0.01 (diverged)" in text
    )
    assert (
        "- the Transporter, stack_block_pyramid: 0.001, chosen from 0.001 (9.25 nats), "
        "0.0003 (12.00 nats)" in text
    )


def test_a_run_that_does_not_fit_its_name_is_rejected(runs: tuple[Run, ...]):
    good = runs[0]

    def spoiled(**fields: Any) -> list[Run]:
        return [Run(good.name, {**good.summary, **fields})]

    scenario = {**good.summary["resolved_scenario"], "cameras": {}}
    said = r"run 'unseen_so2_180_100' does not fit the cell of this name \(camer"
    with pytest.raises(UserError, match=said):
        cell_results(spoiled(resolved_scenario=scenario), {})
    with pytest.raises(UserError, match="outcomes"):
        cell_results(spoiled(outcomes=3), {})
    for fields in ({"outcomes": None}, {"seeds": None}):
        with pytest.raises(UserError, match=r"run 'unseen_so2_180_100' (is not|does not fit)"):
            cell_results(spoiled(**fields), {})
    rates = {"unseen_equivariant_transporter": {"0.001": 4.0, "0.0003": 2.5}}
    with pytest.raises(UserError, match=r"learning_rate is 0\.001, not 0\.0003"):
        cell_results(runs, rates)
    other = Run("mine", good.summary)
    assert cell_results([other], {}) == ([], [other], [])


def test_unrepeatable_runs_are_marked_differently_from_missing_ones(runs: tuple[Run, ...]):
    name = "unseen_so2_180_100"
    marked = [
        Run(run.name, run.summary | ({"commit": "01234567, 89abcdef+"} if run.name == name else {}))
        for run in runs
    ]
    text = sections(marked)
    assert rows(text)["SO(2)-equivariant (ours)", "100"] == ["-"] * 3 + ["- ‡"]
    assert f"| {name} " not in text.split("### Every cell")[1]
    assert "Another 1 cells, marked ‡" in text
    found = cell_results(marked, {})
    assert [run.name for run in found.set_aside] == [name]
    assert len(found.results) == len(runs) - 1


def test_damaged_learning_rates_are_an_error(tmp_path: Path):
    assert read_rates(tmp_path) == {}
    for content in ("[]", '{"unseen_equivariant_transporter": {}}', "{"):
        (tmp_path / RATES).write_text(content)
        with pytest.raises(UserError, match=r"learning_rates\.json is damaged"):
            read_rates(tmp_path)


def test_no_results_no_sections():
    assert fresh_tools([]) == paper_sections([]) == protocol_sections([], {}) == []


def test_figure_6_is_drawn_from_the_existing_results(runs: tuple[Run, ...]):
    found = cell_results(runs, {}).results
    assert has_figure("unseen", found)
    assert not has_figure("seen", found)
    assert "results_unseen.png" in sections(runs)
    results = {result.cell.name: result for result in found}
    drawn = draw_figure_6("unseen", results)
    assert drawn.startswith(b"\x89PNG")
    assert drawn != draw_figure_6("seen", results)


def test_table_1_is_drawn_from_the_existing_results(runs: tuple[Run, ...]):
    found = cell_results(runs, {}).results
    assert has_table_1(found)
    assert "results_ravens.png" in sections(runs)
    results = {result.cell.name: result for result in found}
    drawn = draw_table_1(results)
    assert drawn.startswith(b"\x89PNG")
    del results["stack_block_pyramid_so2_36_10"]
    assert drawn != draw_table_1(results)
    assert not has_table_1(results.values())
    assert "results_ravens.png" not in "\n".join(paper_sections(list(results.values())))


def test_flat_shapes_show_the_four_measures_of_each_cell():
    assert flat_shapes_table([]) == "No runs yet.\n"
    shares = {"strict": 0.5, "ravens": 0.75, "maniskill": 0.6, "add_s": 0.7}
    measures = {
        name: {"success_rate": share, "ci95": [share - 0.1, share + 0.1]}
        for name, share in shares.items()
    }
    cell = CELLS["assembling_kits_transporter_36_10"]
    table = rows(flat_shapes_table([Result(cell, {"measures": measures})]))
    assert table["Transporter", "10"] == [
        "50.0 (40.0 to 60.0)",
        "75.0 (65.0 to 85.0)",
        "60.0 (50.0 to 70.0)",
        "70.0 (60.0 to 80.0)",
    ]
    assert table["Transporter", "1"] == ["-"] * 4
    assert table["generalist", ""] == ["-"] * 4
