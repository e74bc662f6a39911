"""A tool's pose is found in a cavity that was made for its model."""

import math

import pytest
from manifold3d import CrossSection

from kitting_drake.hkd.kits.layout import cavity_outline
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.kits.seating import find_seat

EASY = KitParameters(clearance=0.35e-3, tolerance=1e-5)


def wrench(length: float = 0.18) -> CrossSection:
    head = CrossSection.circle(0.015, 64).translate((length / 2 - 0.015, 0.004))
    return CrossSection.square((length, 0.012), True) + head


def test_a_turned_and_moved_outline_is_found_with_its_room():
    model = wrench()
    tool = model.rotate(170).translate((0.004, -0.002))
    seat = find_seat(tool, model, cavity_outline(model, EASY))
    assert seat.room == pytest.approx(0.35e-3, abs=3e-5)
    back = tool.rotate(math.degrees(seat.yaw)).translate((seat.x, seat.y))
    assert (back - model).area() < 0.02 * model.area()


def test_a_bite_in_the_model_leaves_no_room():
    bite = CrossSection.square((0.03, 0.001), True).translate((0.0, -0.0055))
    model = wrench() - bite
    seat = find_seat(wrench(), model, cavity_outline(model, EASY))
    assert seat.room < 0
    # At the bite the tool is 0.3 mm wider than the cavity: 0.15 mm on each side.
    assert seat.room == pytest.approx((0.7e-3 - 1e-3) / 2, abs=1e-4)
