import numpy as np
import pytest
import trimesh

from kitting_drake.hkd.grasps.grip import find_grip


def bar(angle_deg: float, y: float) -> np.ndarray:
    """The triangles of a bar of 160 x 18 x 12 mm on the table, rotated, then moved along y."""
    mesh = trimesh.creation.box((0.16, 0.018, 0.012))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(angle_deg), (0, 0, 1)))
    mesh.apply_translation((0, y, 0.006))
    return np.asarray(mesh.triangles)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, -75.0])
def test_a_bar_between_the_jaws(angle_deg: float):
    grip = find_grip(bar(angle_deg, 0.0), 0.0, 0.0, np.radians(angle_deg), 0.0176)
    assert grip is not None
    assert (grip.width, grip.middle, grip.top) == pytest.approx((0.018, 0, 0.012), abs=1e-12)


def test_coordinates_are_relative_to_the_hand():
    grip = find_grip(bar(0.0, 0.005), 0.01, 0.002, 0.0, 0.0176)
    assert grip is not None
    assert (grip.low, grip.high) == pytest.approx((-0.006, 0.012))
    assert grip.middle == pytest.approx(0.003)


def test_only_the_surface_between_the_ends_of_the_pads_counts():
    # The short pads reach 8.8 mm from their middle, the long ones 11.2 mm. The second bar begins at
    # 10 mm.
    both = np.concatenate([bar(0.0, 0.0), bar(90.0, 0.0) + (0.019, 0, 0)])
    narrow, wide = (find_grip(both, 0.0, 0.0, 0.0, length) for length in (0.0176, 0.0224))
    assert narrow is not None and wide is not None
    assert narrow.width == pytest.approx(0.018)
    assert wide.width == pytest.approx(0.160)


def test_there_is_no_grip_beyond_the_end():
    assert find_grip(bar(0.0, 0.0), 0.1, 0.0, 0.0, 0.0176) is None
