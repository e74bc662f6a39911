"""Room for the fingers at release, computed from known heights."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.matching.release_clearance import blocked_at_place
from kitting_drake.policies.networks.architecture import PLACE_CROP, NetworkConfig
from kitting_drake.policies.networks.factored import AnglePrediction, Networks, PickPrediction
from kitting_drake.policies.stages import ReleaseRoom, SubPixel, make_stages
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid

GRID = PixelGrid(x_min=0.3, y_min=-0.2, resolution=0.004, rows=97, cols=129, z_min=0.0, z_max=0.3)
PICK, PLACE = np.array([60, 25]), np.array([40, 90])
CUBE = 0.040
PAD = 0.005
"""The height of the support at the place, in m."""
SPACING = 0.052
"""The distance between the centres of neighbouring cubes (m), too little for the fingers."""
PLANNER = PickPlaceParameters()


def heights(heading: float | None, lifted: float = 0.0) -> NDArray[np.float32]:
    """Heights of a scene with a cube at the pick.

    With a heading, there is also a support at the place, and on it two cubes, one on either side of
    the place along the heading.
    """
    found = np.zeros(GRID.shape, np.float32)
    rows, cols = np.indices(GRID.shape)

    def box(middle, size: float, top: float, angle: float = 0.0) -> None:
        row, col = (rows - middle[0]) * GRID.resolution, (cols - middle[1]) * GRID.resolution
        along = row * math.cos(angle) + col * math.sin(angle)
        aside = -row * math.sin(angle) + col * math.cos(angle)
        found[(abs(along) <= size / 2) & (abs(aside) <= size / 2)] = top

    box(PICK, CUBE, CUBE)
    if heading is not None:
        box(PLACE, 3 * SPACING, PAD + lifted, heading)
        for side in (-1, 1):
            away = (
                side * SPACING / GRID.resolution * np.array([math.cos(heading), math.sin(heading)])
            )
            box(PLACE + away, CUBE, PAD + lifted + CUBE, heading)
    return found


def blocked(
    height: NDArray[np.float32],
    theta: float,
    rotation: float,
    planner: PickPlaceParameters = PLANNER,
) -> float:
    return blocked_at_place(
        height, GRID.resolution, PICK * 1.0, theta, rotation, PLACE * 1.0, planner
    )


@pytest.mark.parametrize("heading", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("lifted", [0.0, 0.040])
def test_fingers_have_room_across_a_row_and_none_along_it(heading: float, lifted: float):
    found = heights(heading, lifted)
    # With the hand at theta, the jaws close along (-sin theta, cos theta).
    for half_turn in (0.0, math.pi):
        assert blocked(found, 0.0, heading + half_turn) == 0.0
        assert blocked(found, 0.0, heading + half_turn + math.pi / 2) > 0.1
        assert blocked(found, math.pi / 2, heading + half_turn + math.pi / 2) == 0.0
        assert blocked(found, math.pi / 2, heading + half_turn) > 0.1


def test_opening_and_depth_are_those_of_the_planner():
    along = heights(0.0), 0.0, math.pi / 2
    # Fingers that open less at release stay farther from the neighbours.
    assert blocked(*along, PickPlaceParameters(release_clearance=0.001)) < blocked(*along) - 0.05
    # In a shallow grasp the fingers stay above the neighbours, which are lower than the cube.
    low = heights(0.0)
    low[low > CUBE + PAD / 2] = PAD + 0.024
    deep = PickPlaceParameters(grasp_depth=0.035, max_grasp_depth=0.035)
    assert blocked(low, 0.0, math.pi / 2) == 0.0
    assert blocked(low, 0.0, math.pi / 2, deep) > 0.1


def test_nothing_is_blocked_on_a_bare_table_or_at_the_image_s_edge():
    found = heights(None)
    assert blocked(found, 0.3, 1.0) == 0.0
    corner = np.array([0.0, GRID.cols - 1.0])
    assert blocked_at_place(found, GRID.resolution, corner, 0.0, 0.0, corner, PLANNER) == 0.0


class Cubes(Networks):
    """Networks that predict a cube's place; its four quarter turns score equally well."""

    def __init__(self) -> None:
        super().__init__(NetworkConfig(preset="tiny"))

    def predict_pick(self, image, orientations: int) -> PickPrediction:
        position = torch.zeros(image.shape[1:])
        position[tuple(PICK)] = 9.0
        return PickPrediction(
            position, lambda _: AnglePrediction(torch.eye(1, orientations // 2)[0], 0.0), None
        )

    def encode_scene(self, image) -> torch.Tensor:
        return _corners(GRID.shape, PLACE)

    def encode_crop(self, image, pixel) -> torch.Tensor:
        return _corners((PLACE_CROP, PLACE_CROP), np.array([PLACE_CROP // 2] * 2))


def _corners(shape, middle) -> torch.Tensor:
    rows, cols = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    blobs = [
        torch.exp(-((rows - middle[0] - row) ** 2 + (cols - middle[1] - col) ** 2) / 8)
        for row, col in ((12, 12), (12, -12), (-12, 12), (-12, -12))
    ]
    return 9 * torch.stack(blobs).sum(0)[None, None]


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("heading", [0.0, math.pi / 2])
def test_of_equally_good_rotations_the_one_with_room_is_taken(heading: float, continuous: bool):
    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = heights(heading)
    seen = Observation(image, GRID)
    room = ReleaseRoom(PLANNER)
    stages = [SubPixel(), room] if continuous else [room]
    policy = LearnedPolicy(Cubes(), orientations=72, stages=stages)
    found = policy.decide(seen)
    np.testing.assert_allclose(found.place_pixel, PLACE, atol=0.5)
    jaws = found.action.place.theta
    assert abs(math.remainder(jaws - heading, math.pi)) < math.radians(3)


def test_a_worse_rotation_is_not_taken():
    """An L fits in one rotation only. The policy keeps it even if the jaws have no room to open."""

    class Corner(Cubes):
        def encode_scene(self, image) -> torch.Tensor:
            return _corners(GRID.shape, PLACE) * _quadrant(GRID.shape, PLACE)

        def encode_crop(self, image, pixel) -> torch.Tensor:
            shape = (PLACE_CROP, PLACE_CROP)
            middle = np.array([PLACE_CROP // 2] * 2)
            return _corners(shape, middle) * _quadrant(shape, middle)

    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = heights(math.pi / 2)
    policy = LearnedPolicy(Corner(), orientations=72, stages=make_stages(PLANNER, insertion=False))
    assert abs(policy.decide(Observation(image, GRID)).action.place.theta) < math.radians(3)


def _quadrant(shape, middle) -> torch.Tensor:
    rows, cols = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    return ((rows < middle[0]) | (cols < middle[1])).float()
