"""`benchmark reliability`: how it resumes, and its table and diagram from random decisions."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.policies.confidence import read_reliability
from kitting_drake.reproduction.benchmarks import reliability
from kitting_drake.reproduction.benchmarks.reliability import (
    LEAST_CONFIDENCE,
    POLICIES,
    Judged,
    measure_reliability,
    summarize_all,
)
from kitting_drake.reproduction.benchmarks.reliability_report import (
    draw_reliability,
    limits_table,
    reliability_table,
)


def drawn(policy: str, seed: int) -> list[Judged]:
    """Random decisions. The better the fit, the more of them are right.

    Their scenes have, in turn, the default cameras, one random camera, or three random cameras.
    """
    random = np.random.default_rng(seed)
    names = read_reliability(policy).weights
    found = []
    for scene in range(300):
        fit = random.uniform(0, 2)
        right = random.random() < 1 / (1 + np.exp(6 * (fit - 1.2)))
        evidence = {name: random.normal() for name in names if name} | {"fit": fit}
        cameras = (0, 1, 3)[scene % 3]
        found.append(Judged(policy, scene, "right" if right else "place", evidence, cameras))
        if scene % 10 == 0:
            found.append(Judged(policy, scene, "stop", {}, cameras, "done"))
    return found


def test_a_fit_is_cross_validated_and_reported(tmp_path: Path):
    judged = [item for number, policy in enumerate(POLICIES) for item in drawn(policy, number)]
    measured = summarize_all(judged, None, tmp_path)
    for policy in POLICIES:
        found = measured[policy]
        assert found["all"]["decisions"] == 300 and found["one random camera"]["decisions"] == 100
        assert found["all"]["calibration_error"] < 0.1
        # The policy acts at a confidence of 0.9 or more, so under a tenth of its answers are wrong.
        assert found["all"]["wrong_answers"] < 0.1
        # With a higher limit, more right decisions are refused.
        limits = [(item["least_confidence"], item["refused"]) for item in found["limits"]]
        assert limits == sorted(limits) and limits[0][1] < limits[-1][1]
        assert (LEAST_CONFIDENCE, found["all"]["refused"]) in limits
    # Weights use the confidence file that has their name and is beside them.
    (tmp_path / "confidence.json").rename(tmp_path / "own.confidence.json")
    own = read_reliability("networks", tmp_path / "own.safetensors")
    assert own.threshold == measured["networks"]["threshold"] == LEAST_CONFIDENCE
    assert own.weights != read_reliability("networks").weights

    console = Console(file=io.StringIO(), width=140)
    console.print(reliability_table(measured), limits_table(measured))
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert said.count("generalist") == 7 and "default cameras" in said
    with Image.open(io.BytesIO(draw_reliability(measured))) as picture:
        assert picture.format == "PNG"


def test_an_interrupted_run_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    by_scene: list[list[Judged]] = [[] for _ in range(300)]
    for number, policy in enumerate(POLICIES):
        for item in drawn(policy, number):
            by_scene[item.scene].append(item)
    judged_now: list[int] = []

    def draw(seed: int, numbers: range, weights: Path | None = None) -> Iterator[list[Judged]]:
        for number in numbers:
            if len(judged_now) == 40:
                raise KeyboardInterrupt
            judged_now.append(number)
            yield by_scene[number]

    monkeypatch.setattr(reliability, "draw_judged", draw)
    console = Console(file=io.StringIO())

    def measure(seed: int, count: int, folder: Path) -> dict[str, object]:
        folder.mkdir(exist_ok=True)
        return measure_reliability(seed, count, None, folder, console, fits=False)

    with pytest.raises(KeyboardInterrupt):
        measure(7, 60, tmp_path / "cut")
    judged_now[:] = []
    resumed = measure(7, 60, tmp_path / "cut")
    assert judged_now == list(range(40, 60))
    with pytest.raises(UserError, match="seed is 8, but 7 in them"):
        measure(8, 60, tmp_path / "cut")

    judged_now[:] = []
    measure(7, 30, tmp_path / "whole")
    judged_now[:] = []
    assert measure(7, 60, tmp_path / "whole") == resumed


def test_too_few_scenes_for_a_fit_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="at least 60 scenes"):
        measure_reliability(7, 59, None, tmp_path, Console(file=io.StringIO()), fits=True)
