"""The queue of the paper's experiments, with fake commands."""

import copy
import dataclasses
import itertools
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from kitting_drake import benchmark
from kitting_drake.common.errors import DIVERGED, UserError
from kitting_drake.common.files import alone_in
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reproduction.page.run_table import Summary, add_run, read_summaries
from kitting_drake.reproduction.page.runs import described
from kitting_drake.reproduction.paper.cell_results import check_cell
from kitting_drake.reproduction.paper.cells import (
    LEARNING_RATES,
    PRESET,
    TASKS,
    Cell,
    Training,
    reference,
)
from kitting_drake.reproduction.paper.learning_rates import RATES
from kitting_drake.reproduction.paper.paper_tables import paper_cells
from kitting_drake.reproduction.paper.queue import Failed, Queue
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.policies import QuantizedOracle

ORACLE = Cell("unseen", "!QuantizedOracle {orientations: 180}", 180, "quantized_oracle")
OURS = Cell("unseen", Training("unseen", "so2", 180, 10), 36, end_at_success=True)
THEIRS = Cell("unseen", Training("unseen", "transporter", 36, 10), 36)


COUNTED = ("orientations", "demonstrations", "steps", "seed")


class Pretending(Queue):
    """A queue with fake commands, which only write the files that the real ones would write."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        self.calls: list[str] = []
        self.broken: set[str] = set()
        self.why = "it broke"
        self.commit = "c0ffee"
        self.collected: dict[str, int] = {}
        """The number of demonstrations that were requested, by the name of their folder."""

    def _command(self, verb: str, *arguments, folder: Path) -> None:
        self.calls.append(f"{verb} {folder.name}")
        if folder.name in self.broken:
            raise Failed(self.why)
        folder.mkdir(parents=True, exist_ok=True)
        words = list(map(str, arguments))
        flags = dict(itertools.pairwise(words))
        if verb == "collect":
            self.collected[folder.name] = int(flags["--demos"])
            (folder / "demonstrations.h5").touch()
        elif verb == "train":
            rate = float(flags["--learning-rate"])
            summary = {"best": {"cost_mm": 1.0 if rate == LEARNING_RATES[1] else 2.0}}
            summary |= {key: int(flags[f"--{key}"]) for key in COUNTED}
            if folder.name.startswith("stack_block_pyramid"):
                # On a Ravens task the learning rate is chosen by the loss, not by the cost.
                summary["best"]["loss"] = 7.0 + (rate != LEARNING_RATES[0])
            summary |= {"method": flags["--method"], "preset": flags["--preset"]}
            summary["angle_only"] = "--angle-only" in words
            if "--rotations" in flags:
                summary["rotations"] = int(flags["--rotations"])
            (folder / "summary.json").write_text(json.dumps(summary))
            (folder / "policy.safetensors").touch()
        else:
            (folder / "summary.json").write_text(json.dumps(self.summary(words, flags)))

    def summary(self, words: list[str], flags: dict[str, str]) -> dict:
        scenario = load_scenario(Path(words[0]), flags["--scenario_name"], flags["--scenario_text"])
        policy = scenario.policy
        first, count = int(flags["--seed"]), int(flags["--episodes"])
        details = {"orientations": policy.orientations}
        if hasattr(policy, "weights"):
            trained_by = Path(policy.weights).with_name("summary.json")
            folder = trained_by.parent.name
            trained_as = json.loads(trained_by.read_text())
            task, method, trained, demonstrations = folder.split("_")[:4]
            details |= {
                "method": method,
                "scenario": f"{Path(TASKS[task].file).stem}:{TASKS[task].demonstrated}",
                "preset": trained_as["preset"],
                "rotations": trained_as.get("rotations"),
                "trained_orientations": int(trained),
                "demonstrations": int(demonstrations),
                "training_seed": 0,
                "steps": trained_as["steps"],
                "learning_rate": float(folder.rpartition("_lr")[2]),
                "decay": True,
                "continuous": policy.continuous,
                "fit_outlines": policy.fit_outlines,
                "recover": policy.recover,
                "taken_only": "ours" not in folder,
                "rigid": "ours" not in folder,
            }
        return {
            "resolved_scenario": described(scenario),
            "seeds": list(range(first, first + count)),
            "policy_details": details,
            "policy_digest": None if isinstance(policy, QuantizedOracle) else "sha256 f00d",
            "commit": self.commit,
            "outcomes": [],
            "strict_success_rate": 1.0,
            "success_rate": 1.0,
        }


@pytest.fixture
def queue(tmp_path: Path) -> Pretending:
    (tmp_path / "results").mkdir()
    return Pretending(tmp_path / "work", tmp_path / "results", Console(quiet=True))


def test_cells_have_unique_names_and_valid_scenarios():
    cells = paper_cells()
    assert len({cell.name for cell in cells}) == len(cells) > 100
    for cell in cells:
        task = TASKS[cell.task]
        text = cell.scenario_text("w.safetensors")
        scenario = load_scenario(SCENARIOS / task.file, task.tested, text)
        assert (scenario.planner.search.steps > 0) == cell.search
        assert scenario.end_at_success == cell.end_at_success
    for task in TASKS.values():
        load_scenario(SCENARIOS / task.file, task.demonstrated, "{policy: !Oracle {}}")


def test_it_chooses_a_learning_rate_and_repeats_nothing(queue: Pretending):
    cells = [OURS, THEIRS, ORACLE]
    assert queue.run(cells) == {}
    first, best, _ = LEARNING_RATES
    assert [call for call in queue.calls if call.startswith("train")] == [
        f"train unseen_so2_180_10_seed0_lr{first:g}",
        *(f"train {reference(THEIRS.policy).name}_lr{rate:g}" for rate in LEARNING_RATES),
        f"train unseen_transporter_36_10_seed0_lr{best:g}",
    ]
    assert [c for c in queue.calls if c.startswith("collect")] == [
        "collect unseen",
        "collect unseen_validation",
    ]
    rates = json.loads((queue.results / RATES).read_text())
    costs = {f"{rate:g}": 1.0 if rate == best else 2.0 for rate in LEARNING_RATES}
    assert rates == {"unseen_transporter": costs}
    written = json.dumps(read_summaries(queue.results)[OURS.name])
    assert str(queue.folder) not in written
    assert "trainings/unseen_so2_180_10" in written

    queue.calls.clear()
    assert queue.run(cells) == {}
    assert queue.calls == []


def test_a_cell_with_an_unrepeatable_run_is_run_again(
    queue: Pretending, summaries: dict[str, Summary]
):
    add_run(queue.results, ORACLE.name, summaries[ORACLE.name] | {"commit": "c0ffee+"})
    assert queue.pending([ORACLE]) == [ORACLE]
    queue.commit = "f00d, c0ffee+"
    (failure,) = queue.run([ORACLE]).values()
    assert "its episodes are from commit f00d, c0ffee+, with uncommitted changes" in failure
    assert read_summaries(queue.results)[ORACLE.name]["commit"] == "c0ffee+"
    queue.commit = "f00d"
    assert queue.run([ORACLE]) == {}
    assert read_summaries(queue.results)[ORACLE.name]["commit"] == "f00d"
    assert queue.pending([ORACLE]) == []


def test_known_learning_rates_are_not_tried_again(queue: Pretending):
    costs = {f"{rate:g}": 1.0 + (rate != LEARNING_RATES[1]) for rate in LEARNING_RATES}
    (queue.results / RATES).write_text(json.dumps({"unseen_transporter": costs}))
    queue.run([THEIRS])
    assert [call for call in queue.calls if call.startswith("train")] == [
        f"train unseen_transporter_36_10_seed0_lr{LEARNING_RATES[1]:g}"
    ]


def test_some_tasks_choose_their_own_learning_rate(queue: Pretending):
    costs = {f"{rate:g}": 1.0 + (rate != LEARNING_RATES[1]) for rate in LEARNING_RATES}
    (queue.results / RATES).write_text(json.dumps({"unseen_transporter": costs}))
    cells = {cell.name: cell for cell in paper_cells()}
    queue.train(cells["stack_block_pyramid_transporter_36_10"].policy)
    queue.train(cells["block_insertion_transporter_36_10"].policy)
    best = f"{LEARNING_RATES[0]:g}"
    assert [call for call in queue.calls if call.startswith("train")] == [
        *(f"train stack_block_pyramid_transporter_36_100_seed0_lr{r:g}" for r in LEARNING_RATES),
        f"train stack_block_pyramid_transporter_36_10_seed0_lr{best}",
        f"train block_insertion_transporter_36_10_seed0_lr{LEARNING_RATES[1]:g}",
    ]
    losses = {f"{rate:g}": 7.0 + (rate != LEARNING_RATES[0]) for rate in LEARNING_RATES}
    assert json.loads((queue.results / RATES).read_text()) == {
        "stack_block_pyramid_transporter": losses,
        "unseen_transporter": costs,
    }


def test_a_training_may_fix_its_learning_rate(queue: Pretending):
    rates = {"unseen_transporter": {f"{rate:g}": rate for rate in LEARNING_RATES}}
    (queue.results / RATES).write_text(json.dumps(rates))
    steadier = dataclasses.replace(THEIRS.policy, learning_rate=LEARNING_RATES[0])
    cell = dataclasses.replace(THEIRS, policy=steadier)
    assert queue.run([cell]) == {}
    assert f"train {steadier.name}_lr{LEARNING_RATES[0]:g}" in queue.calls
    summary = read_summaries(queue.results)[cell.name]
    assert cell.departure(summary, rates) is None
    assert THEIRS.departure(summary, rates).startswith("learning_rate is 0.001, not 0.0003")


def test_networks_that_do_not_depend_on_n_are_trained_once(queue: Pretending):
    """In the Equivariant Transporter, only the angle network depends on N."""
    costs = {f"{rate:g}": rate for rate in LEARNING_RATES}
    (queue.results / RATES).write_text(json.dumps({"unseen_equivariant_transporter": costs}))
    cells = {cell.name: cell for cell in paper_cells()}
    for n in (36, 72):
        queue.train(cells[f"seen_equivariant_transporter_{n}_100"].policy)
    rate = min(LEARNING_RATES)
    assert [call for call in queue.calls if call.startswith("train")] == [
        f"train seen_equivariant_transporter_180_100_seed0_lr{rate:g}",
        f"train seen_equivariant_transporter_36_100_angle_only_seed0_lr{rate:g}",
        f"train seen_equivariant_transporter_72_100_angle_only_seed0_lr{rate:g}",
    ]
    whole = cells["seen_equivariant_transporter_180_100"].policy
    assert whole.base is None
    assert cells["seen_equivariant_transporter_36_100"].policy.base == whole
    assert cells["block_insertion_equivariant_transporter_36_100"].policy.base is None


def test_more_steps_are_another_training(queue: Pretending):
    patient = Cell(
        "unseen",
        dataclasses.replace(THEIRS.policy, times=3, learning_rate=LEARNING_RATES[0]),
        36,
        "3_times_the_steps",
    )
    assert patient.policy.steps == 3 * THEIRS.policy.steps
    assert queue.run([patient]) == {}
    summary = read_summaries(queue.results)[patient.name]
    assert patient.departure(summary) is None
    at_once = dataclasses.replace(patient, policy=dataclasses.replace(patient.policy, times=1))
    assert at_once.departure(summary).startswith("steps is")


def test_a_matched_baseline_is_another_training(queue: Pretending):
    cells = {cell.name: cell for cell in paper_cells()}
    chance = cells["unseen_transporter_36_100_every_chance"]
    assert chance.policy.name == (
        "unseen_transporter_36_100_3_times_the_steps_matched_18_rotations_seed0"
    )
    costs = {f"{rate:g}": rate for rate in LEARNING_RATES}
    known = {f"unseen_{method}": costs for method in ("transporter", "equivariant_transporter")}
    (queue.results / RATES).write_text(json.dumps(known))
    assert queue.run([chance]) == {}
    summary = read_summaries(queue.results)[chance.name]
    assert chance.departure(summary) is None
    for change, said in (
        ({"preset": PRESET}, "preset is matched, not small"),
        ({"rotations": None}, "rotations is 18, not None"),
    ):
        other = dataclasses.replace(chance, policy=dataclasses.replace(chance.policy, **change))
        assert other.policy.name != chance.policy.name
        assert other.departure(summary) == said
    # The Equivariant Transporter starts from a policy of figure 6, which is trained first.
    theirs = cells["unseen_equivariant_transporter_36_100_every_chance"].policy
    assert theirs.base == cells["unseen_equivariant_transporter_180_100"].policy
    queue.calls.clear()
    queue.train(theirs)
    assert [call for call in queue.calls if call.startswith("train")] == [
        f"train {theirs.base.name}_lr{min(LEARNING_RATES):g}",
        f"train {theirs.name}_lr{min(LEARNING_RATES):g}",
    ]


def test_networks_at_another_learning_rate_do_not_count_as_trained(queue: Pretending):
    many, few = (Training("seen", "transporter", 36, count) for count in (100, 10))
    for rate in LEARNING_RATES:
        queue.train(dataclasses.replace(reference(many), learning_rate=rate))
    other, _, chosen = sorted(LEARNING_RATES, reverse=True)
    queue.train(dataclasses.replace(few, learning_rate=other))
    queue.calls.clear()
    assert queue.run([Cell("seen", many, 36), Cell("seen", few, 36)]) == {}
    assert [call for call in queue.calls if call.startswith("train")] == [
        f"train {training.name}_lr{chosen:g}" for training in (many, few)
    ]


def test_a_run_collects_only_the_demonstrations_that_its_cells_need(queue: Pretending):
    assert queue.run([OURS]) == {}
    assert queue.collected == {"unseen": 10, "unseen_validation": TASKS["unseen"].validation}
    more = dataclasses.replace(OURS, policy=Training("unseen", "so2", 180, 100))
    again = Pretending(queue.folder, queue.results, Console(quiet=True))
    assert again.run([OURS, more]) == {}
    assert again.collected["unseen"] == 100


def test_a_failed_cell_does_not_stop_the_others(queue: Pretending):
    queue.broken = {f"{reference(THEIRS.policy).name}_lr{LEARNING_RATES[2]:g}"}
    assert queue.run([THEIRS, OURS, ORACLE]) == {THEIRS.name: "it broke"}
    assert queue.pending([THEIRS, OURS, ORACLE]) == [THEIRS]
    queue.broken = set()
    queue.calls.clear()
    assert queue.run([THEIRS, OURS, ORACLE]) == {}
    assert queue.calls[0].endswith(f"_lr{LEARNING_RATES[2]:g}")


def test_a_diverging_learning_rate_is_the_worst(queue: Pretending):
    queue.broken = {f"{reference(THEIRS.policy).name}_lr{LEARNING_RATES[1]:g}"}
    queue.why = f"train failed with exit code 2: error: {DIVERGED} at step 3"
    assert queue.run([THEIRS]) == {}
    assert json.loads((queue.results / RATES).read_text())["unseen_transporter"] == {
        f"{rate:g}": None if rate == LEARNING_RATES[1] else 2.0 for rate in LEARNING_RATES
    }
    assert queue.calls[-1] == f"evaluate {THEIRS.name}"
    queue.calls.clear()
    assert queue.run([THEIRS]) == {}
    assert queue.calls == []


def test_existing_demonstrations_are_checked_once(queue: Pretending):
    """The check is a call of `collect`, which rejects demonstrations of another scenario."""
    queue.collect(TASKS["unseen"], validation=False)
    again = Pretending(queue.folder, queue.results, Console(quiet=True))
    for _ in range(2):
        again.collect(TASKS["unseen"], validation=False)
    assert again.calls == ["collect unseen"]


@pytest.fixture(scope="module")
def summaries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Summary]:
    """The summaries of two cells of the paper's tables, made by a fake queue."""
    folder = tmp_path_factory.mktemp("queue")
    Pretending(folder / "work", folder, Console(quiet=True)).run([OURS, ORACLE])
    return read_summaries(folder)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s["resolved_scenario"]["planner"]["search"].update(reach=0.004), "search.reach"),
        (lambda s: s["resolved_scenario"]["plant"].update(time_step=0.5), "plant.time_step"),
        (lambda s: s["resolved_scenario"].pop("end_at_success"), "end_at_success: false"),
        (lambda s: s["policy_details"].update(steps=7), "steps is 7, not"),
        (lambda s: s["policy_details"].update(learning_rate=0.1), "learning_rate is 0.1, not"),
        (lambda s: s["policy_details"].update(decay=False), "decay is False, not"),
        (lambda s: s["resolved_scenario"]["planner"].pop("heavy_load"), "an earlier hand"),
        (lambda s: s["policy_details"].update(scenario="kitting_seen:Mine"), "scenario is kitting"),
        (lambda s: s["policy_details"].update(continuous=True), "continuous is True"),
        (lambda s: s["policy_details"].update(angle_only=True), "angle_only is True"),
        (lambda s: s["seeds"].pop(), "seeds are not 3000 to 3099"),
    ],
)
def test_a_summary_that_does_not_fit_is_rejected(
    summaries: dict[str, Summary], change, said: str, queue: Pretending
):
    summary = copy.deepcopy(summaries[OURS.name])
    check_cell(OURS, summary, {})
    change(summary)
    add_run(queue.results, OURS.name, summary)
    with pytest.raises(UserError, match="remove it") as caught:
        queue.run([OURS])
    assert said in str(caught.value)
    assert queue.calls == []


def test_a_policy_without_training_is_checked_too(summaries: dict[str, Summary]):
    summary = copy.deepcopy(summaries[ORACLE.name])
    check_cell(ORACLE, summary, {})
    summary["resolved_scenario"]["policy"]["orientations"] = 72
    with pytest.raises(
        UserError, match=r"its policy is not !QuantizedOracle \{orientations: 180\}"
    ):
        check_cell(ORACLE, summary, {})
    with pytest.raises(UserError, match="not a summary of evaluate"):
        check_cell(ORACLE, {}, {})


def test_shipped_policies_must_have_the_shipped_weights():
    cell = next(cell for cell in paper_cells() if cell.name == "fresh_generalist")
    summary = read_summaries(SCENARIOS.parent / "docs" / "results")[cell.name]
    assert cell.departure(summary) is None
    summary["policy_digest"] = "sha256 of others"
    assert cell.departure(summary) == "its weights are not those that come with the package"


def test_a_training_of_an_earlier_version_is_not_reused(queue: Pretending):
    path = queue.train(OURS.policy).with_name("summary.json")
    path.write_text(path.read_text().replace(f'"steps": {OURS.policy.steps}', '"steps": 7'))
    (failure,) = queue.run([OURS]).values()
    assert f"steps is 7, not {OURS.policy.steps}" in failure


def test_a_failed_command_is_reported_by_its_last_line_and_not_repeated(tmp_path: Path):
    """The queue's real `_command` gets a verb that does not exist."""
    queue = Queue(tmp_path / "work", tmp_path / "results", Console(quiet=True))
    folder = tmp_path / "work" / "trainings" / "one"
    said = r"nothing failed with exit code 1: .*No module named kitting_drake\.nothing"
    with pytest.raises(Failed, match=said):
        queue._command("nothing", folder=folder)
    log = folder.with_name("one.log")
    assert "No module" in log.read_text()
    log.unlink()
    with pytest.raises(Failed, match=said):
        queue._command("nothing", folder=folder)
    assert not log.exists()


def test_cells_are_chosen_by_patterns_in_their_order(tmp_path: Path, monkeypatch, capsys):
    chosen: list[str] = []

    def fill(_: Queue, cells: list[Cell]) -> dict[str, str]:
        chosen.extend(cell.name for cell in cells)
        return {}

    monkeypatch.setattr("kitting_drake.reproduction.paper.queue.run_paper", fill)
    patterns = ["seen_quantized_oracle_36", "*_quantized_oracle_36"]
    arguments = ["benchmark", "paper", "--output", str(tmp_path), "--cells", *patterns]
    arguments += ["--results", str(tmp_path / "results")]
    monkeypatch.setattr(sys, "argv", arguments)
    assert benchmark.main() == 0
    assert chosen == ["seen_quantized_oracle_36", "unseen_quantized_oracle_36"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--cells", "seen_*", "nothing_*"])
    with pytest.raises(UserError, match=r"'nothing_\*'"):
        benchmark.main()


@pytest.mark.parametrize(("failures", "code"), [({}, 0), ({ORACLE.name: "it broke"}, 1)])
def test_the_exit_code_reports_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, failures: dict, code: int
):
    monkeypatch.setattr("kitting_drake.reproduction.paper.queue.run_paper", lambda *_: failures)
    arguments = ["benchmark", "paper", "--cells", ORACLE.name, "--output", str(tmp_path)]
    arguments += ["--results", str(tmp_path / "results")]
    monkeypatch.setattr(sys, "argv", arguments)
    assert benchmark.main() == code
    assert ("it broke" in capsys.readouterr().out) == bool(code)


@pytest.mark.slow
def test_stopping_the_queue_stops_its_child_process(tmp_path: Path):
    """The queue runs the real commands, which lock their folders."""
    command = [sys.executable, "-m", "kitting_drake.benchmark", "paper"]
    command += ["--cells", "unseen_quantized_oracle_180", "--results", str(tmp_path / "results")]
    work = tmp_path / "work"
    command += ["--output", str(work)]
    queue = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    folder = work / "paper" / "evaluations" / "unseen_quantized_oracle_180"
    deadline = time.monotonic() + 120
    while not (folder / "scenario.json").exists():
        assert time.monotonic() < deadline
        assert queue.poll() is None
        time.sleep(0.2)
    queue.terminate()
    output, _ = queue.communicate(timeout=60)
    assert queue.returncode == 128 + signal.SIGTERM
    assert "stopped" in output
    with alone_in(folder):
        pass
