import math

import numpy as np
import pytest

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.registration import (
    coarse_cost,
    preference,
    register,
    trace_outline,
)

RESOLUTION = 0.003125
SHAPE = (160, 320)


def tool(middle: tuple[float, float], angle: float, grown: float = 0.0) -> np.ndarray:
    """The mask of a hammer without symmetry, whose sides are moved outwards by `grown` pixels."""
    rows, cols = np.indices(SHAPE)
    offsets = np.stack([rows, cols], axis=-1) - middle
    u, v = np.moveaxis(offsets @ rotation_matrix(angle), -1, 0)
    shaft = (np.abs(u) < 25 + grown) & (np.abs(v) < 4 + grown)
    head = (np.abs(u - 22) < 5 + grown) & (np.abs(v - 4) < 12 + grown)
    return shaft | head


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, -2.9])
def test_registers_an_outline_to_its_recess(angle: float):
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


def bar(middle: tuple[float, float], angle: float, grown: float = 0.0) -> np.ndarray:
    """The mask of a bar that is wider at one end; its sides are moved out by `grown` pixels."""
    rows, cols = np.indices(SHAPE)
    u, v = np.moveaxis((np.stack([rows, cols], axis=-1) - middle) @ rotation_matrix(angle), -1, 0)
    return (np.abs(u) < 28 + grown) & (np.abs(v) < np.where(u > 18, 4.5, 3.5) + grown)


def test_preference_weighs_the_points_where_two_fits_differ():
    random = np.random.default_rng(5)
    for _ in range(8):
        first, turn = random.uniform(-math.pi, math.pi, 2)
        start, goal = random.uniform((50, 50), (110, 110)), random.uniform((50, 210), (110, 270))
        outline = trace_outline(bar(start, first), RESOLUTION, close=True)
        recess = trace_outline(bar(goal, first + turn, grown=0.64), RESOLUTION)
        shift = recess.middle - rotation_matrix(turn) @ outline.middle
        back = recess.middle - rotation_matrix(turn + math.pi) @ outline.middle
        right = register(outline, recess, starts=((turn, shift),))
        reverse = register(outline, recess, starts=((turn + math.pi, back),))
        found = preference(outline, recess, right, reverse)
        assert found > 0.0001
        assert preference(outline, recess, reverse, right) == pytest.approx(-found)
        assert preference(outline, recess, right, right) == 0


def test_registers_a_small_object_to_a_recess_far_from_its_own_centroid():
    rows, cols = np.indices(SHAPE)
    box = trace_outline((abs(rows - 30) < 4) & (abs(cols - 30) < 4), RESOLUTION, close=True)
    ell = (abs(rows - 80) < 55) & (abs(cols - 160) < 55) & ~((rows > 36) & (cols < 204))
    recess = trace_outline(ell, RESOLUTION)
    assert np.isfinite(register(box, recess).cost)
