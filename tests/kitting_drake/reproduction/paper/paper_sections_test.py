"""The paper's part of the page of results, of summaries made for it."""

import json
import math
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.summary import summarise
from kitting_drake.reproduction.page.runs import described
from kitting_drake.reproduction.paper.cell_results import read_results
from kitting_drake.reproduction.paper.cells import PRESET, TASKS, Cell, Training
from kitting_drake.reproduction.paper.paper_figures import draw_figure_6, draw_table_1
from kitting_drake.reproduction.paper.paper_sections import has_figure, has_table_1, paper_sections
from kitting_drake.reproduction.paper.paper_tables import paper_cells
from kitting_drake.scenario.loader import load_scenario
from tests.kitting_drake.evaluation.episodes import ADD_S, CHOSEN, make_episode

CELLS = {cell.name: cell for cell in paper_cells()}


def write(folder: Path, name: str, errors_mm: list[float]) -> None:
    """The summary of a cell whose episodes are all alike."""
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
            "preset": PRESET,
            "trained_orientations": cell.policy.orientations,
            "angle_only": cell.policy.angle_only,
            "demonstrations": cell.policy.demonstrations,
            "training_seed": cell.policy.seed,
            "steps": cell.policy.steps,
            "learning_rate": 0.001,
            "decay": True,
            "continuous": cell.continuous,
            "fit_outlines": cell.fit_outlines,
            "recover": False,
            "taken_only": cell.policy.taken_only,
            "rigid": cell.policy.rigid,
        }
    summary |= {"resolved_scenario": described(scenario), "policy_details": details}
    if isinstance(cell.policy, str):
        summary["policy_digest"] = scenario.policy.digest(SCENARIOS)
    (folder / f"{name}.json").write_text(json.dumps(summary))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, "unseen_so2_180_100", [1.0, 1.0, 1.0, 9.0])
    write(tmp_path, "unseen_so2_180_100_ours", [1.0, 1.0, 1.0, 1.0])
    write(tmp_path, "unseen_equivariant_transporter_180_100", [1.0, 1.0, 9.0, 9.0])
    write(tmp_path, "unseen_quantized_oracle_180", [1.0, 1.0, 1.0, 1.0])
    write(tmp_path, "stack_block_pyramid_so2_36_10", [1.0, 9.0])
    write(tmp_path, "fresh_shape_matching", [1.0, 1.0, 1.0, 1.0])
    return tmp_path


def rows(text: str) -> dict[tuple[str, ...], list[str]]:
    """The tables' lines, by their first two cells."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {tuple(row[:2]): row[2:] for row in cells}


def test_the_tables_hold_the_cells_and_say_what_is_missing(folder: Path):
    text = "\n".join(paper_sections(read_results(folder), {}, "results"))
    found = rows(text)
    assert found["SO(2)-equivariant (ours)", "100"] == ["-"] * 3 + ["75.0 (70.5 to 79.0) / 75.0"]
    assert found["Transporter", "100"] == ["-", "", "", ""]
    assert found["oracle, quantized", ""][-1].startswith("100.0")
    assert found["unseen_so2_180_100", "Equivariant Transporter"] == ["+25.0 (+25.0 to +25.0)"] * 2
    assert found["unseen_so2_180_100", "oracle, quantized"][0].startswith("-25.0")
    assert found["as in the paper", "75.0 (70.5 to 79.0) / 75.0"] == ["-"]
    assert found["with all extensions", "100.0 (99.0 to 100.0) / 100.0"] == ["-"]
    assert found["without outline fitting", "-"] == [""]
    assert "results/paper/unseen_so2_180_100.json" in text
    assert "misplaced 100" in text
    pyramid = [line for line in text.splitlines() if " 36 |" in line and " 10 |" in line]
    assert any("50.0 (43.1 to 56.9) / 84.5 |" in line for line in pyramid)
    assert found["shape matching", "100.0 (99.0 to 100.0)"][1] == "100.0 (99.0 to 100.0)"
    assert found["generalist", "-"] == ["-", "-"]


def test_the_mean_over_n_is_compared_once_all_of_it_is_there(folder: Path):
    for n in (36, 72, 120):
        write(folder, f"unseen_so2_{n}_100", [1.0, 1.0, 9.0, 9.0])
        label = ("unseen, 100 demonstrations, mean over N", "Equivariant Transporter")
        assert label not in rows("\n".join(paper_sections(read_results(folder), {}, "results")))
        write(folder, f"unseen_equivariant_transporter_{n}_100", [1.0, 1.0, 1.0, 1.0])
    found = rows("\n".join(paper_sections(read_results(folder), {}, "results")))
    # -50 three times and +25 once.
    assert found[label] == ["-31.2 (-31.2 to -31.2)"] * 2


def test_trainings_are_compared_once_there_are_two(folder: Path):
    assert "Variation between trainings" not in "\n".join(
        paper_sections(read_results(folder), {}, "results")
    )
    write(folder, "unseen_so2_180_100_seed2", [1.0, 1.0, 1.0, 1.0])
    found = rows("\n".join(paper_sections(read_results(folder), {}, "results")))
    ours = found["SO(2)-equivariant (ours)", "unseen"]
    # 75 and 100.
    assert ours == ["75.0 / 75.0", "-", "100.0 / 100.0", "87.5 ± 17.7 / 87.5 ± 17.7"]
    assert ("Equivariant Transporter", "unseen") not in found
    write(folder, "unseen_equivariant_transporter_180_100_seed2", [1.0, 1.0, 1.0, 9.0])
    found = rows("\n".join(paper_sections(read_results(folder), {}, "results")))
    label = ("unseen, N = 180, mean over 2 trainings", "Equivariant Transporter")
    assert found[label] == ["+25.0 (+25.0 to +25.0)"] * 2


def test_a_longer_training_is_compared_with_the_same_cell_in_the_usual_steps(tmp_path: Path):
    ours = "stack_block_pyramid_so2_36_100"
    write(tmp_path, ours, [9.0, 9.0])
    write(tmp_path, f"{ours}_ours", [1.0, 9.0])
    write(tmp_path, f"{ours}_3_times_the_steps_ours", [1.0, 1.0])
    text = "\n".join(paper_sections(read_results(tmp_path), {}, "results"))
    name = f"{ours}_3_times_the_steps_ours", "in the usual number of steps"
    assert rows(text)[name][0] == "+50.0 (+50.0 to +50.0)"
    assert "| 100, 3 times the steps | 100.0" in text


def test_an_interval_over_tools_is_given_only_where_tools_are_drawn(folder: Path):
    for name in ("seen_so2_180_100", "unseen_so2_180_100"):
        write(folder, name, [1.0, 1.0, 1.0, 1.0])
        path = folder / f"{name}.json"
        summary = json.loads(path.read_text())
        # Every tool fails once, and so tells something of others.
        summary["outcomes"][0]["objects"] = dict.fromkeys(summary["outcomes"][0]["objects"], 0)
        path.write_text(json.dumps(summary))
    text = "\n".join(paper_sections(read_results(folder), {}, "results"))
    cells = {row.split("]")[0]: row.split(" | ") for row in text.splitlines() if "/paper/" in row}
    assert cells["| [seen_so2_180_100"][9].strip() == "-"
    assert " to " in cells["| [unseen_so2_180_100"][9]


def test_the_learning_rates_that_were_tried_are_told(folder: Path):
    rates = {
        "unseen_transporter": {"0.001": 4.0, "0.0003": 2.5, "0.01": math.inf},
        "stack_block_pyramid_transporter": {"0.001": 9.25, "0.0003": 12.0},
    }
    text = "\n".join(paper_sections(read_results(folder), rates, "results"))
    assert (
        "- the Transporter, unseen: 0.0003 of 0.001 (4.00 mm), 0.0003 (2.50 mm), 0.01 (diverged)"
        in text
    )
    assert (
        "- the Transporter, stack_block_pyramid: 0.001 of 0.001 (9.25 nats), 0.0003 (12.00 nats)"
        in text
    )


def test_a_file_that_is_not_what_its_name_says_is_refused(folder: Path):
    path = folder / "unseen_so2_180_100.json"
    good = json.loads(path.read_text())
    summary = json.loads(path.read_text())
    summary["resolved_scenario"]["cameras"] = {}
    path.write_text(json.dumps(summary))
    with pytest.raises(UserError, match=r"unseen_so2_180_100\.json is not that of its cell: camer"):
        read_results(folder)
    path.rename(folder / "mine.json")
    with pytest.raises(UserError, match=r"mine\.json is of no cell"):
        read_results(folder)
    (folder / "mine.json").unlink()
    for content in ("[]", '{"unseen_equivariant_transporter": {}}'):
        (folder / "learning_rates.json").write_text(content)
        with pytest.raises(UserError, match=r"learning_rates\.json is damaged"):
            read_results(folder)
    rates = {"unseen_equivariant_transporter": {"0.001": 4.0, "0.0003": 2.5}}
    (folder / "learning_rates.json").write_text(json.dumps(rates))
    with pytest.raises(UserError, match=r"learning_rate is 0\.001, not 0\.0003"):
        read_results(folder)
    (folder / "learning_rates.json").unlink()
    for field in ("outcomes", "versions"):
        path.write_text(json.dumps({**good, field: 3}))
        with pytest.raises(UserError, match=r"is no summary of evaluate: .*must be"):
            read_results(folder)
    path.write_text("{}")
    with pytest.raises(UserError, match="lacks 'task': it must be a summary"):
        read_results(folder)


def test_no_results_no_sections(tmp_path: Path):
    assert read_results(tmp_path / "none") == []
    assert paper_sections([], {}, "results") == []


def test_the_figure_is_drawn_from_what_there_is(folder: Path):
    found = read_results(folder)
    assert has_figure("unseen", found)
    assert not has_figure("seen", found)
    assert "results_unseen.png" in "\n".join(paper_sections(found, {}, "results"))
    results = {result.cell.name: result for result in read_results(folder)}
    drawn = draw_figure_6("unseen", results)
    assert drawn.startswith(b"\x89PNG")
    assert drawn != draw_figure_6("seen", results)


def test_table_1_is_drawn_from_what_there_is(folder: Path):
    found = read_results(folder)
    assert has_table_1(found)
    assert "results_ravens.png" in "\n".join(paper_sections(found, {}, "results"))
    results = {result.cell.name: result for result in found}
    drawn = draw_table_1(results)
    assert drawn.startswith(b"\x89PNG")
    del results["stack_block_pyramid_so2_36_10"]
    assert drawn != draw_table_1(results)
    assert not has_table_1(results.values())
    assert "results_ravens.png" not in "\n".join(paper_sections(list(results.values()), {}, "r"))
