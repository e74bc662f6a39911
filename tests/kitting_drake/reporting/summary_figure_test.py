from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from kitting_drake.reporting.summary import summarise
from kitting_drake.reporting.summary_figure import draw_summary
from kitting_drake.scenario.command_line import ChosenScenario
from kitting_drake.scenario.schema import Scenario

CHOSEN = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)


@pytest.mark.parametrize("failed", [False, True])
def test_draws_whatever_there_is(
    failed: bool, made_up_episode: Callable[..., dict[str, Any]], tmp_path: Path
):
    episodes = [made_up_episode(seed, [1.0, 9.0, 500.0, 0.0]) for seed in range(3)]
    if failed:
        empty = {"objects": [], "actions_taken": [], "failure": "died", "success_rate": 0.0}
        episodes = [episode | empty for episode in episodes]
    path = tmp_path / "summary.png"
    draw_summary(summarise(episodes, CHOSEN, wall_seconds_total=1.0), episodes, path)
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert pixels.shape[1] > 1000
    assert (pixels == (0, 114, 178)).all(axis=2).any() != failed  # The hammer's colour.
