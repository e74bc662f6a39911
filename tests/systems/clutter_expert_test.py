import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.clutter_expert import ClutterExpert
from systems.cluttered_table import ClutteredTable, in_the_way
from systems.free_area import find_free_pose
from systems.grasp import Grasp
from systems.hand_geometry import PALM_HEIGHT
from systems.ledge import Ledge
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.placement import PlacedObject
from systems.signals import PickPlaceAction, PlanarPose

AREA = ((0.25, -0.5), (0.75, 0.5))
KIT = RigidTransform([0.5, -0.3, 0.0])
X_WGOAL = RigidTransform([0.5, -0.3, 0.035])
RIM = 0.05


def box_points(length: float, width: float, height: float, spacing: float = 0.004) -> np.ndarray:
    """Points on the surface of a box whose origin is the middle of its bottom."""
    x, y, z = (
        np.linspace(low, high, max(2, round((high - low) / spacing) + 1))
        for low, high in ((-length / 2, length / 2), (-width / 2, width / 2), (0, height))
    )
    grid = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)
    inside = (np.abs(grid[:, 0]) < length / 2 - 1e-9) & (np.abs(grid[:, 1]) < width / 2 - 1e-9)
    inside &= (grid[:, 2] > 1e-9) & (grid[:, 2] < height - 1e-9)
    return grid[~inside]


def wedge_points() -> np.ndarray:
    """Points on a bar with a block beside one end, whose outline is not its own mirror image."""
    return np.concatenate(
        [box_points(0.18, 0.02, 0.012), box_points(0.03, 0.03, 0.012) + (0.07, 0.025, 0)]
    )


BAR = PlacedObject("bar", BodyIndex(1), wedge_points())
OTHER = PlacedObject("other", BodyIndex(2), wedge_points())
GRASPS = tuple(Grasp(x, 0.0, 0.0, 0.02, 0.012) for x in (0.0, 0.025, -0.05, -0.075))


def pose(
    x: float, y: float, yaw: float = 0.0, *, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0
):
    return RigidTransform(RollPitchYaw(roll, pitch, yaw), [x, y, z])


def expert(*poses: RigidTransform, failed: tuple[PlanarPose, ...] = ()) -> ClutterExpert:
    table = ClutteredTable(
        objects=(BAR, OTHER)[: len(poses)],
        grasps=(GRASPS, GRASPS)[: len(poses)],
        area=AREA,
        fixtures=[KIT.multiply(box_points(0.28, 0.26, 0.05).T).T],
        ledge=Ledge(PlanarPose(0.5, -0.3, 0.0), (0.28, 0.26)),
    )
    return ClutterExpert(table, poses, failed)


def to_goal(clutter: ClutterExpert) -> PickPlaceAction | None:
    return clutter.to_goal(0, X_WGOAL, RIM)


def test_a_free_tool_goes_to_its_goal():
    action = to_goal(expert(pose(0.5, 0.2, 0.3), pose(0.5, 0.4)))
    assert action is not None and not action.aside
    assert (action.pick.x, action.pick.y, action.pick.theta) == pytest.approx((0.5, 0.2, 0.3))
    assert (action.place.x, action.place.y, action.place.theta) == pytest.approx((0.5, -0.3, 0.0))
    assert action.heights is not None
    assert action.heights.pick_top == pytest.approx(0.012)
    assert action.heights.place_rim == RIM


def test_a_tool_under_another_waits():
    clutter = expert(pose(0.5, 0.2), pose(0.5, 0.2, math.pi / 2, z=0.0125))
    assert to_goal(clutter) is None
    action = clutter.aside([0, 1])
    assert action is not None and action.aside
    assert action.pick.theta % math.pi == pytest.approx(math.pi / 2)
    # The place is on the table, clear of the other tool and the kit.
    away = np.hypot(action.place.x - 0.5, action.place.y - 0.2)
    assert away > 0.1 and action.place.y > -0.1


def test_a_tilted_tool_is_laid_aside_by_its_best_grasp():
    """The best grasp is near the centre of mass; at a higher one a heavy tool would slip."""
    clutter = expert(pose(0.5, 0.2, pitch=-0.2, z=0.02))
    assert to_goal(clutter) is None
    action = clutter.aside([0])
    assert action is not None and action.aside
    assert action.pick.x == pytest.approx(0.5, abs=0.01)


def test_a_tool_between_others_is_gripped_where_it_is_free():
    # The other tool leaves no room for the fingers at the first two grasps.
    clutter = expert(pose(0.5, 0.2), pose(0.6, 0.165, math.pi))
    assert to_goal(clutter) is None
    action = clutter.aside([0])
    assert action is not None
    assert action.pick.x == pytest.approx(0.5 - 0.075, abs=0.03)


def test_the_jaws_open_less_beside_another_tool():
    # The other tool is 25 mm away. Fully open, each jaw needs 45 mm.
    action = to_goal(expert(pose(0.5, 0.2), pose(0.6, 0.155, math.pi)))
    assert action is not None and action.heights is not None
    assert action.heights.width == pytest.approx(0.02, abs=0.001)


def test_a_tool_beside_the_tall_kit_is_gripped_higher():
    # The palm would hit the kit, 8 cm away.
    action = to_goal(expert(pose(0.5, -0.08)))
    assert action is not None and action.heights is not None
    assert motion_heights(action.heights, PickPlaceParameters()).grasp > 0.05 - PALM_HEIGHT
    # Nearer to the kit the fingers have no room either, so the tool is laid elsewhere.
    start = pose(0.5, -0.145)
    clutter = expert(start)
    assert to_goal(clutter) is None
    action = clutter.aside([0])
    assert action is not None
    turn = RollPitchYaw(0, 0, action.place.theta - action.pick.theta).ToRotationMatrix()
    moved = turn @ (start.translation() - [action.pick.x, action.pick.y, 0.0])
    laid = RigidTransform(turn, moved + [action.place.x, action.place.y, 0.0])
    assert to_goal(expert(laid)) is not None


def test_a_failed_grasp_is_not_repeated():
    action = to_goal(expert(pose(0.5, 0.2), failed=(PlanarPose(0.5, 0.2, math.pi),)))
    assert action is not None
    assert action.pick.x == pytest.approx(0.525)


def test_after_many_failed_picks_the_tools_take_turns():
    lower, upper = pose(0.5, 0.2), pose(0.5, 0.2, math.pi / 2, z=0.0125)
    for count, theta in ((3, math.pi / 2), (4, 0.0)):
        failed = tuple(PlanarPose(0.5, 0.2 + 0.01 * k, 0.7) for k in range(count))
        action = expert(lower, upper, failed=failed).aside([0, 1])
        assert action is not None
        assert math.remainder(action.pick.theta - theta, math.pi) == pytest.approx(0, abs=1e-6)


def test_a_tool_the_wrong_way_up_is_turned_over_the_block():
    turned = pose(0.5, 0.2, 0.4, roll=math.pi, z=0.012)
    clutter = expert(turned)
    assert to_goal(clutter) is None
    action = clutter.aside([0])
    assert action is not None and action.aside
    # The place is near an edge of the block.
    at = np.abs((KIT.inverse() @ [action.place.x, action.place.y, 0.0])[:2]) - (0.14, 0.13)
    assert np.abs(at).min() < 0.015


def test_a_turned_tool_of_the_same_shape_need_not_be_turned():
    rod = PlacedObject("rod", BodyIndex(1), box_points(0.18, 0.02, 0.012, spacing=0.0015))
    table = ClutteredTable(objects=[rod], grasps=[GRASPS], area=AREA)
    assert table.flat_heading(0, pose(0.5, 0.2, 0.4, roll=math.pi)) == pytest.approx(0.4)
    assert table.flat_heading(0, pose(0.5, 0.2, roll=0.8)) is None


def test_the_hand_keeps_clear():
    gripper = PlanarPose(0.5, 0.0, 0.0)

    def count(x: float, y: float, z: float) -> int:
        return in_the_way(np.array([[x, y, z]]), gripper, 0.01, (0.01, 0.04))

    assert count(0.5, 0.03, 0.02) and not count(0.5, 0.03, 0.005)
    assert not count(0.5, 0.005, 0.02) and not count(0.52, 0.03, 0.02)
    # Above their tips the fingers are thicker, and higher up the palm is wider.
    assert count(0.5, 0.06, 0.04) and not count(0.5, 0.06, 0.02)
    assert count(0.52, 0.09, 0.08) and not count(0.52, 0.09, 0.04)


def test_a_free_pose_has_room():
    outline = box_points(0.1, 0.02, 0.01)[:, :2]
    wall = np.stack([np.linspace(0.25, 0.75, 300), np.full(300, 0.05)], axis=1)
    occupied = np.concatenate([wall + (0, dy) for dy in np.arange(-0.05, 0.46, 0.004)])
    found = find_free_pose(outline, occupied, AREA, near=np.array([0.5, 0.3]), yaw=0.0)
    assert found is not None and found.y < -0.05
    everywhere = np.concatenate([wall + (0, dy) for dy in np.arange(-0.55, 0.46, 0.004)])
    assert find_free_pose(outline, everywhere, AREA, near=np.zeros(2), yaw=0.0) is None
