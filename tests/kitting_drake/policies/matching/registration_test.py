import math

import numpy as np
import pytest

from kitting_drake.policies.images import rotation_matrix
from kitting_drake.policies.matching.registration import (
    coarse_cost,
    register,
    trace_outline,
)

RESOLUTION = 0.003125
SHAPE = (160, 320)


def tool(middle: tuple[float, float], angle: float, grown: float = 0.0) -> np.ndarray:
    """A hammer without symmetry, drawn at pixel centres; `grown` in pixels."""
    rows, cols = np.indices(SHAPE)
    offsets = np.stack([rows, cols], axis=-1) - middle
    u, v = np.moveaxis(offsets @ rotation_matrix(angle), -1, 0)
    shaft = (np.abs(u) < 25 + grown) & (np.abs(v) < 4 + grown)
    head = (np.abs(u - 22) < 5 + grown) & (np.abs(v - 4) < 12 + grown)
    return shaft | head


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, -2.9])
def test_an_outline_is_brought_into_its_recess(angle: float):
    random = np.random.default_rng(int(10 * abs(angle)))
    start, goal = random.uniform((40, 40), (120, 140)), random.uniform((40, 200), (120, 280))
    first = random.uniform(-math.pi, math.pi)
    outline = trace_outline(tool(start, first), RESOLUTION, close=True)
    recess = trace_outline(tool(goal, first + angle, grown=0.64), RESOLUTION)
    found = register(outline, recess)
    assert abs(math.remainder(found.rotation - angle, math.tau)) < math.radians(0.6)
    assert np.linalg.norm(found.moved(start) - goal) * RESOLUTION < 0.0006
    assert found.cost < 0.001


def test_the_half_turn_costs_more():
    outline = trace_outline(tool((60, 80), 0.4), RESOLUTION, close=True)
    recess = trace_outline(tool((90, 220), 1.1, grown=0.64), RESOLUTION)
    right = register(outline, recess)
    reverse = register(
        outline,
        recess,
        starts=(
            (
                right.rotation + math.pi,
                right.moved(outline.middle)
                - rotation_matrix(right.rotation + math.pi) @ outline.middle,
            ),
        ),
    )
    assert reverse.cost > 1.5 * right.cost


def test_a_recess_of_another_shape_costs_more():
    outline = trace_outline(tool((60, 80), 0.4), RESOLUTION, close=True)
    own = trace_outline(tool((90, 220), 1.1, grown=0.64), RESOLUTION)
    rows, cols = np.indices(SHAPE)
    bar = trace_outline((np.abs(rows - 90) < 6) & (np.abs(cols - 220) < 26), RESOLUTION)
    assert coarse_cost(outline, bar) > 1.5 * coarse_cost(outline, own)
    assert register(outline, bar).cost > 2 * register(outline, own).cost
