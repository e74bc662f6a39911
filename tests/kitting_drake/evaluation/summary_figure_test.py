from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from kitting_drake.evaluation.summary import summarise
from kitting_drake.evaluation.summary_figure import _COLOURS, _looks, draw_summary
from systems.placement import SuccessPredicate
from systems.success import PoseWithin
from tests.kitting_drake.evaluation.episodes import (
    ADD_S,
    CHOSEN,
    make_episode,
    make_lost_episode,
    make_object,
    make_result,
)

NINE = [make_object(f"thing {number}", 0.5 + number) for number in range(9)]


@pytest.mark.parametrize(
    ("episodes", "success", "categories"),
    [
        pytest.param(
            [make_episode(seed, [1.0, 9.0, 500.0, 0.0]) for seed in range(3)],
            ADD_S,
            4,
            marks=pytest.mark.slow,
        ),
        # More categories than colours, and an object for which no goal was left.
        ([make_result(0, [*NINE, make_object("spare", None)]).as_dict()], PoseWithin(), 9),
        pytest.param(
            [make_episode(0, [1.0], timed_out=True)], PoseWithin(), 1, marks=pytest.mark.slow
        ),
        pytest.param([make_lost_episode(0)], ADD_S, 1, marks=pytest.mark.slow),
    ],
)
def test_draw_summary(
    episodes: list[dict[str, Any]], success: SuccessPredicate, categories: int, tmp_path: Path
):
    summary = summarise(episodes, CHOSEN, success, wall_seconds_total=1.0)
    assert len(summary["categories"]) == categories
    path = tmp_path / "summary.png"
    draw_summary(summary, episodes, path)
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert pixels.shape[1] > 1000
    for colour in _COLOURS[: min(categories, len(_COLOURS))]:
        rgb = np.round(255 * np.array(to_rgb(colour)))
        assert (pixels == rgb).all(axis=2).any(), colour


def test_categories_have_distinct_styles():
    looks = [look for look, _ in zip(_looks(), range(21), strict=False)]
    assert len(set(looks)) == 21
    # Bars are told apart by colour and hatch, curves by colour and line style.
    assert len({(look.colour, look.hatch) for look in looks}) == 21
    assert len({(look.colour, look.line) for look in looks}) == 21
