"""The table and diagram of `benchmark reliability`, made from random decisions."""

import io
import json
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console

from kitting_drake.policies.confidence import read_reliability
from kitting_drake.reproduction.benchmarks.reliability import (
    LEAST_CONFIDENCE,
    POLICIES,
    Judged,
    as_lines,
    summarize_all,
)
from kitting_drake.reproduction.benchmarks.reliability_report import (
    draw_reliability,
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
    path = tmp_path / "decisions.jsonl"
    path.write_text("".join(line + "\n" for line in as_lines(judged)))
    lines = path.read_text().splitlines()
    assert [Judged(**json.loads(line)) for line in lines] == judged

    measured = summarize_all(judged, None, tmp_path)
    for policy in POLICIES:
        found = measured[policy]
        assert found["all"]["decisions"] == 300 and found["one random camera"]["decisions"] == 100
        assert found["all"]["calibration_error"] < 0.1
        # The policy acts at a confidence of 0.9 or more, so under a tenth of its answers are wrong.
        assert found["all"]["wrong_answers"] < 0.1
    # Weights use the confidence file that has their name and is beside them.
    (tmp_path / "confidence.json").rename(tmp_path / "own.confidence.json")
    own = read_reliability("networks", tmp_path / "own.safetensors")
    assert own.threshold == measured["networks"]["threshold"] == LEAST_CONFIDENCE
    assert own.weights != read_reliability("networks").weights

    console = Console(file=io.StringIO(), width=140)
    console.print(reliability_table(measured))
    said = console.file.getvalue()  # type: ignore[attr-defined]
    assert said.count("the generalist") == 4 and "default cameras" in said
    with Image.open(io.BytesIO(draw_reliability(measured))) as picture:
        assert picture.format == "PNG"
