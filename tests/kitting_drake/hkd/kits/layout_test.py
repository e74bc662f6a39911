import itertools

import pytest
from manifold3d import CrossSection, JoinType

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.layout import kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool, load_tool

NAMES = ["claw_hammer", "slip_joint_pliers", "combination_wrench", "flat_screwdriver"]


@pytest.fixture(scope="module")
def tools() -> list[Tool]:
    return [load_tool(name) for name in NAMES]


@pytest.fixture(scope="module")
def least(tools: list[Tool]) -> KitParameters:
    """The smallest block found for the tools."""
    return layout_kit(tools, KitParameters(always_nested=True)).parameters


def on_block(length: float, width: float) -> KitParameters:
    return KitParameters(length=length, width=width, always_nested=True, fixed_size=True)


def test_a_toolset_can_be_nested(least: KitParameters):
    slots = KitParameters()
    assert least.length * least.width < 0.8 * slots.length * slots.width


@pytest.mark.parametrize("excess", [0.0, 0.004, 0.05])
def test_a_block_of_given_size_keeps_its_walls(
    tools: list[Tool], least: KitParameters, excess: float
):
    for length, width in itertools.permutations((least.length + excess, least.width + excess)):
        parameters = on_block(length, width)
        layout = layout_kit(tools, parameters)
        assert (layout.parameters.length, layout.parameters.width) == (length, width)
        wall = parameters.nested_wall - 1e-6
        cavities = kit_cavities(tools, parameters, layout.poses)
        room = CrossSection.square((length - 2 * wall, width - 2 * wall), True)
        for cavity in cavities:
            assert (cavity.rim - room).area() < 1e-10
        for one, other in itertools.combinations(cavities, 2):
            grown = one.rim.offset(wall, JoinType.Round, circular_segments=128)
            assert (grown ^ other.rim).area() < 1e-10


def test_the_error_for_a_small_block_suggests_a_size(tools: list[Tool], least: KitParameters):
    wanted = f"{1e3 * least.length:.0f} by {1e3 * least.width:.0f} mm"
    with pytest.raises(UserError, match=rf"150 by 200 mm .*: .*{wanted}$"):
        layout_kit(tools, on_block(0.15, 0.2))
