"""The figures in README.md, docs/findings.md, docs/robustness.md and docs/results.md agree with the
result files.

They are recomputed here from the outcomes of the episodes, independently of the code that writes
the pages.
"""

import csv
import json
import math
import re
from fnmatch import filter as matching
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kitting_drake.common.provenance import is_reproducible
from kitting_drake.reproduction.page.run_table import Summary, read_summaries
from kitting_drake.reproduction.paper.paper_sections import EARLIER_MARK

TREE = Path(__file__).parents[3]
RESULTS = TREE / "docs" / "results"
METHODS = {
    "SO(2)-equivariant (ours)": "so2",
    "Equivariant Transporter": "equivariant_transporter",
    "Transporter": "transporter",
}
POLICIES = ("so2_small_180_100", "generalist", "shape_matching")
"""The policies' names in the names of runs, in the order of the columns of docs/robustness.md."""
STRICT, OWN = 2, 1
"""The least outcome that counts as a success by the strict measure, and by a task's own."""


@pytest.fixture(scope="module")
def runs() -> dict[str, Summary]:
    """The runs, by name, that come from a clean commit."""
    found = read_summaries(RESULTS)
    return {name: run for name, run in found.items() if is_reproducible(run["commit"])}


@pytest.fixture(scope="module")
def readme() -> str:
    return (TREE / "README.md").read_text()


def rows(page: str, *sections: str) -> list[list[str]]:
    """The rows of all tables of a page, each as a list of its cells.

    `sections` are headings, in their order on the page. If there are any, only the tables under the
    last one count.
    """
    for section in sections:
        page = page.split(section, 1)[1]
    lines = page.split("\n#", 1)[0].splitlines() if sections else page.splitlines()
    tables = [line.strip("|").split("|") for line in lines if line.startswith("|")]
    return [[cell.strip() for cell in line] for line in tables]


def one_line(text: str) -> str:
    return " ".join(text.split())


def half_up(value: float) -> int:
    return math.floor(value + 0.5 + 1e-9)


def counts(found: list[Summary], least: int = STRICT) -> tuple[int, int]:
    """The number of objects whose outcome is at least `least`, and the number of all objects."""
    ends = [end for run in found for item in run["outcomes"] for end in item["objects"].values()]
    return sum(end >= least for end in ends), len(ends)


def wilson(good: int, objects: int) -> tuple[float, float]:
    """The 95 % Wilson interval of `good / objects`."""
    z, share = 1.959963984540054, good / objects
    middle = share + z**2 / (2 * objects)
    half = z * math.sqrt(share * (1 - share) / objects + z**2 / (4 * objects**2))
    return tuple((middle + sign * half) / (1 + z**2 / objects) for sign in (-1, 1))


def share(found: list[Summary], least: int = STRICT) -> str:
    """The percentage of objects whose outcome is at least `least`, and its interval.

    In the format of README.md.
    """
    good, objects = counts(found, least)
    low, high = wilson(good, objects)
    return short(f"{100 * good / objects:.1f} ({100 * low:.1f} to {100 * high:.1f})")


def short(text: str) -> str:
    """A text in the format of README.md, which shows 100.0 as 100."""
    return text.replace("100.0", "100")


def reward(run: Summary) -> str:
    """The mean reward of a run and its interval, in per cent."""
    rate = np.mean([item["success_rate"] for item in run["outcomes"]])
    low, high = run["ci95"]
    return f"{100 * rate:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def percent(runs: dict[str, Summary], name: str) -> int:
    return half_up(100 * float(np.mean([item["success_rate"] for item in runs[name]["outcomes"]])))


@pytest.fixture(scope="module")
def headline(readme: str) -> list[list[str]]:
    """The rows of the table of results in README.md, without its head."""
    return [row for row in rows(readme, "## Results") if len(row) == 5][2:]


def test_the_shipped_policies_in_the_readme(runs: dict[str, Summary], headline: list[list[str]]):
    generalist = [
        [name for name in runs if re.fullmatch(r"unseen_generalist_\d+", name)],
        ["fresh_generalist"],
        [name for name in runs if re.fullmatch(r"robust_all_generalist_\d+", name)],
    ]
    matching = ["unseen_shape_matching_2600"]
    for row, names in zip(headline[:4], [*generalist, matching], strict=True):
        assert row[2:4] == ["strict", share([runs[name] for name in names])]
    assert ["generalist" in row[1] for row in headline[:4]] == [True, True, True, False]
    assert len({runs[name]["policy_digest"] for names in generalist for name in names}) == 1


def test_the_papers_experiments_in_the_readme(runs: dict[str, Summary], headline: list[list[str]]):
    assert len(headline) == 9
    for row, task in zip(headline[4:6], ("unseen", "seen"), strict=True):
        assert row[0] == task
        assert row[2:4] == ["ADD-S", share([runs[f"{task}_so2_180_100"]], OWN)]
    for task in ("block_insertion", "place_red_in_green", "align_box_corner"):
        assert task.replace("_", " ") in headline[6][0]
        assert percent(runs, f"{task}_so2_180_100") == 100
    assert headline[6][2:] == ["reward", "100 each", "100 each"]
    for row, task, paper in zip(
        headline[7:], ("stack_block_pyramid", "palletizing_boxes"), ("99.0", "100"), strict=True
    ):
        assert row[0] == task.replace("_", " ")
        run = runs.get(f"{task}_so2_180_100")
        found = "no valid result yet" if run is None else short(reward(run))
        assert row[2:] == ["reward", found, paper]


def ahead_of_ours(runs: dict[str, Summary], method: str, task: str, count: int) -> float:
    """By how many points another method's strict success exceeds ours, averaged over N."""
    ours, other = (
        np.mean([counts([runs[f"{task}_{it}_{n}_{count}"]])[0] / 4 for n in (36, 72, 120, 180)])
        for it in ("so2", method)
    )
    return float(other - ours)


def test_the_sentences_of_the_findings(runs: dict[str, Summary]):
    text = one_line((TREE / "docs" / "findings.md").read_text())
    behind = {
        (task, count): ahead_of_ours(runs, "equivariant_transporter", task, count)
        for task in ("unseen", "seen")
        for count in (100, 10)
    }
    assert (
        f"its strict success is {behind['unseen', 100]:.1f} points higher on unseen tools and "
        f"{-behind['seen', 100]:.1f} points lower on seen tools. After ten demonstrations it is "
        f"{behind['unseen', 10]:.1f} points higher and {-behind['seen', 10]:.1f} points lower"
    ) in text
    usual, larger = (
        f"{counts([runs[f'unseen_equivariant_transporter_36_100{label}']])[0] / 4:.1f}"
        for label in ("", "_every_chance")
    )
    assert f"as large as ours gains nothing there: {larger} %, and {usual} % as it is" in text
    seeds = ("", "_seed1", "_seed2")
    spread = max(
        np.ptp([counts([runs[f"{task}_{method}_180_100{seed}"]])[0] / 4 for seed in seeds])
        for task in ("unseen", "seen")
        for method in ("so2", "equivariant_transporter")
    )
    assert f"training seed changes a method's success by up to {spread:.1f} points" in text
    cells = [f"stack_block_pyramid_so2_{name}" for name in ("36_10", "36_100", "180_100")]
    plain = [f"{100 * runs[name]['success_rate']:.1f}" for name in cells]
    extended = [f"{100 * runs[name + '_ours']['success_rate']:.1f}" for name in cells]
    assert (
        f"reaches {plain[0]} % after 10 demonstrations at N = 36, and {plain[1]} and {plain[2]} % "
        "after 100 at N = 36 and 180."
    ) in text
    assert f"it reaches {extended[0]}, {extended[1]} and {extended[2]} %." in text
    single = [
        f"{100 * runs[f'stack_block_pyramid_so2_{n}_1_ours']['success_rate']:.1f}"
        for n in (36, 180)
    ]
    assert f"After one demonstration they gain nothing: {single[0]} and {single[1]} %" in text
    ablation = {
        name: f"{counts([runs[f'unseen_so2_180_100{name}']])[0] / 4:.1f}"
        for name in ("", "_ours", "_minus_curvature", "_minus_refinement")
    }
    assert f"from {ablation['']} to {ablation['_ours']} %" in text
    assert f"without them it is {ablation['_minus_curvature']} %" in text
    assert f"refinement of the actions it is {ablation['_minus_refinement']} %" in text
    red, longer = (
        [percent(runs, f"place_red_in_green_so2_{n}_1{steps}") for n in (36, 180)]
        for steps in ("", "_3_times_the_steps")
    )
    assert (
        f"place red in green ({red[0]} and {red[1]} %, at N = 36 and 180; "
        f"{longer[0]} and {longer[1]} % with three times the training steps)"
    ) in text
    other = percent(runs, "place_red_in_green_equivariant_transporter_36_1")
    assert f"the Equivariant Transporter is no better: {other} % at N = 36" in text
    pyramid, boxes = (
        [f"{100 * float(runs[f'{task}_so2_{n}_1']['success_rate']):.1f}" for n in orientations]
        for task, orientations in (("stack_block_pyramid", (36, 180)), ("palletizing_boxes", (36,)))
    )
    assert f"the pyramid ({pyramid[0]} and {pyramid[1]} %)" in text
    assert f"palletizing ({boxes[0]} %, at N = 36)" in text
    rows_of = json.loads((RESULTS / "networks.json").read_text())["pick_angle"]
    seconds = {
        (row["method"], row["preset"], row["orientations"]): row["seconds"] for row in rows_of
    }
    factors = [
        seconds["equivariant_transporter", preset, 180] / seconds["so2", preset, 180]
        for preset in ("small", "paper")
    ]
    assert (
        f"a factor of {factors[0]:.0f} at the size used here (preset `small`) and of "
        f"{factors[1]:.0f} at the paper's size (`paper`)"
    ) in text
    for preset in ("small", "paper"):
        assert seconds["equivariant_transporter", preset, 36] < seconds["so2", preset, 36]


def robust_share(runs: dict[str, Summary], pattern: str, counted: bool) -> str:
    found = [run for name, run in runs.items() if re.fullmatch(pattern, name)]
    if not found:
        return "-"
    good, objects = counts(found)
    low, high = wilson(good, objects)
    text = f"{100 * good / objects:.1f} ({100 * low:.0f} to {100 * high:.0f})"
    return f"{text}, {objects}" if counted else text


def test_the_tables_on_robustness(runs: dict[str, Summary]):
    page = (TREE / "docs" / "robustness.md").read_text()
    part = page.split("<!-- figures -->")[1].split("<!-- end of figures -->")[0]
    common, others, needless, pooled = (
        rows(table)[1:] for table in part.split("| perturbation")[1:]
    )
    for table, seeds, counted in (
        (common, "2870", False),
        (others, "2870", True),
        (pooled, r"\d+", True),
    ):
        for label, *cells in table:
            axis, _, level = label.split(",")[0].strip("`").partition(":")
            kind = "none" if axis == "unperturbed" else axis
            kind += "" if level in ("", "moderate") else f"_{level}"
            kind += "_frames" if label.endswith("frames") else ""
            for policy, cell in zip(POLICIES, cells, strict=False):
                expected = robust_share(runs, f"robust_{kind}_{policy}_{seeds}", counted)
                assert cell == expected, (label, policy)
    for label, *cells in needless:
        kind = label.strip("`").split(":")[0]
        for policy, cell in zip(POLICIES, cells, strict=True):
            run = runs[f"robust_{kind}_{policy}_2870"]
            known = "needless_actions" in run
            assert cell == (f"{run['needless_actions']} of {run['actions']}" if known else "-")


def test_the_sentences_on_robustness(runs: dict[str, Summary]):
    page = (TREE / "docs" / "robustness.md").read_text()
    text = one_line(page)

    def kitted(name: str) -> str:
        run = runs[name]
        objects = sum(row["objects"] for row in run["categories"].values())
        return f"{round(objects * run['strict_success_rate'])} of {objects}"

    assert f"placed {kitted('colours_and_lights_generalist')} unseen tools" in text
    table = rows(page, "### Real meshes and laser scans")[2:]
    names = (
        "real_tools_generalist",
        "real_tools_shape_matching",
        "real_scans_generalist",
        "real_scans_shape_matching",
        "real_scans_oracle",
    )
    for row, name in zip(table, names, strict=True):
        assert row[2:] == [kitted(name), str(min(runs[name]["seeds"]))], name
    lost = [runs[f"robust_all_generalist_{seed}"] for seed in (2870, 2900, 3500)]
    good, objects = counts(lost)
    assert (objects - good, objects) == (16, 300)
    assert "failed on sixteen of three hundred tools" in text
    lost_rows = rows(page, "### Failures")[2:]
    assert [row[0] for row in lost_rows] == ["10", "4", "1", "1"]
    causes: dict[str, int] = {
        name: sum(run["causes"].get(name, 0) for run in lost) for name in lost[0]["causes"]
    }
    assert {name: count for name, count in causes.items() if count} == {
        "misplaced": 4,
        "reversed": 3,
        "insertion blocked": 1,
    }
    assert sum(run["ambiguous"]["reversed"] for run in lost) == 7
    late = [runs[f"robust_all_generalist_{seed}"] for seed in range(90000, 103000, 2000)]
    good, objects = counts(late)
    reversed_ones = sum(run["ambiguous"]["reversed"] for run in late)
    assert f"together {100 * good / objects:.1f} %" in text
    assert f"{reversed_ones} of their {objects - good} lost tools are offset" in text
    times = rows(page, "### How long it takes")[2:]
    for row, kind in zip(times, ("none", "depth_noise", "all"), strict=True):
        seconds = [
            runs[f"robust_{kind}_{policy}_2870"]["sim_seconds"] / 25 for policy in POLICIES[1:]
        ]
        assert row[1:] == [f"{value:.1f} s" for value in seconds]


def test_figure_6_and_table_1_of_the_results(runs: dict[str, Summary]):
    page = (TREE / "docs" / "results.md").read_text()
    kept = read_summaries(RESULTS).keys()

    def check(cell: str, name: str, expected: Any) -> None:
        found = cell.split(" / ")[0] if name not in runs else cell
        assert found == (expected() if name in runs else "- ‡" if name in kept else "-"), name

    for task in ("Seen toolset", "Unseen toolsets"):
        for row in rows(page, "## As in the paper", f"### {task}")[2:]:
            if row[0] not in METHODS:
                continue
            for n, cell in zip((36, 72, 120, 180), row[2:], strict=True):
                name = f"{task.split()[0].lower()}_{METHODS[row[0]]}_{n}_{row[1]}"
                if cell:
                    check(cell, name, lambda name=name: f"{strict(runs[name])} / {own(runs[name])}")
    heading, _, *table = rows(page, "### The five Ravens tasks, table I")
    for row in table:
        if row[0] in METHODS and len(row) == len(heading):
            for task, cell in zip(heading[3:], row[3:], strict=True):
                name = f"{task}_{METHODS[row[0]]}_{row[1]}_{row[2]}"
                figure = cell.split(" / ")[0].removesuffix(EARLIER_MARK)
                check(figure, name, lambda name=name: reward(runs[name]))


def strict(run: Summary) -> str:
    good, objects = counts([run])
    low, high = wilson(good, objects)
    return f"{100 * good / objects:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def own(run: Summary) -> str:
    good, objects = counts([run], OWN)
    return f"{100 * good / objects:.1f}"


def test_the_mishaps_name_existing_runs():
    names = read_summaries(RESULTS).keys()
    with (RESULTS / "mishaps.csv").open(newline="") as file:
        listed = list(csv.DictReader(file))
    assert all(all(row.values()) for row in listed)
    for row in listed:
        for pattern in row["runs"].split():
            assert "_" not in pattern or matching(names, pattern), pattern
