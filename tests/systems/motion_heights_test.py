import pytest

from systems.motion_heights import motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import SurfaceHeights


@pytest.mark.parametrize(("height", "tip"), [(0.005, 0.00075), (0.011, 0.0015), (0.040, 0.024)])
def test_the_pads_enclose_the_middle_of_a_thin_object(height: float, tip: float):
    """A pin of 5 mm that is gripped above its middle is squeezed out of the jaws."""
    table = 0.002
    surfaces = SurfaceHeights(pick_top=table + height, support=table, table=table)
    found = motion_heights(surfaces, PickPlaceParameters()).grasp
    assert found == pytest.approx(table + tip)


def test_a_larger_clearance_counts_at_thin_objects_too():
    wider = PickPlaceParameters(floor_clearance=0.003)
    assert motion_heights(SurfaceHeights(pick_top=0.005), wider).grasp == pytest.approx(0.0015)
