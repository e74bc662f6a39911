import dataclasses
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.data.images import Image
from kitting_drake.policies.draft import best_placement, expected_position
from kitting_drake.policies.learned_policy import DEFAULT_STAGES, Decision, LearnedPolicy
from kitting_drake.policies.networks.architecture import PLACE_CROP, NetworkConfig
from kitting_drake.policies.networks.factored import AnglePrediction, Networks, PickPrediction
from kitting_drake.policies.networks.layers.correlation import Candidate
from kitting_drake.policies.networks.layers.steerable import PlainConv2d
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.stages import SubPixel
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

# All values differ from the defaults, so that a policy that ignores the grid fails.
GRID = PixelGrid(x_min=0.3, y_min=-0.2, resolution=0.004, rows=97, cols=129, z_min=0.02, z_max=0.3)
PICK = (61.3, 22.4)
GOAL = np.array([40, 90])
N = 72
BIN = math.tau / N
ROTATION = 19
THETA = math.radians(62.0)
ARMS = ((0, 0), (0, 18), (9, 0))
"""The (row, col) offset of the blob in each channel of an encoding, relative to the pick."""


def blob(shape: tuple[int, int], centre: tuple[float, float] | NDArray[np.float64]) -> Tensor:
    row, col = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    return torch.exp(-((row - centre[0]) ** 2 + (col - centre[1]) ** 2) / 8)


def linear(shape: tuple[int, ...], label: tuple[float, ...]) -> Tensor:
    """The logits with the least loss for a label that lies between entries of the grid."""
    offsets = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    shares = [(1 - (n - at).abs()).clamp(min=0) for n, at in zip(offsets, label, strict=True)]
    return torch.stack(shares).prod(0).double().log().float()


def rotated(vector: tuple[float, float] | NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """A (row, col) vector rotated counter-clockwise about world +z. Row is along x, col along y."""
    row, col = vector
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * row - sin * col, sin * row + cos * col])


class Known(Networks):
    """Networks that make given predictions. Scene and crop encodings match only at GOAL."""

    def __init__(
        self,
        *,
        pick: tuple[float, float] = PICK,
        theta: float = THETA,
        rotation: float = ROTATION * BIN,
        refines_angles: bool = True,
        log_odds: float | None = None,
    ) -> None:
        super().__init__(NetworkConfig(preset="tiny"))
        self._pick, self._theta, self._rotation = pick, theta, rotation
        self._refines_angles, self._log_odds = refines_angles, log_odds
        self.crops: list[tuple[int, int]] = []

    def predict_pick(self, image: Image, orientations: int) -> PickPrediction:
        def angle(pixel: tuple[int, int]) -> AnglePrediction:
            angles = torch.arange(orientations // 2) * (math.tau / orientations)
            logits = 9 * torch.cos(2 * (angles - self._theta))
            return AnglePrediction(logits, self._theta if self._refines_angles else None)

        return PickPrediction(linear(image.shape[1:], self._pick), angle, self._log_odds)

    def encode_scene(self, image: Image) -> Tensor:
        ends = [GOAL + rotated(arm, self._rotation) for arm in ARMS]
        return 99 * torch.stack([blob(GRID.shape, end) for end in ends])[None]

    def encode_crop(self, image: Image, pixel: tuple[int, int]) -> Tensor:
        self.crops.append(pixel)
        middle = PLACE_CROP // 2
        shape = (PLACE_CROP, PLACE_CROP)
        return torch.stack([blob(shape, np.add(arm, middle)) for arm in ARMS])[None]


def observation() -> Observation:
    return Observation(np.zeros((4, *GRID.shape), np.float32), GRID)


def decide(networks: Networks, *, continuous: bool, seen: Observation | None = None) -> Decision:
    policy = LearnedPolicy(networks, orientations=N, stages=DEFAULT_STAGES if continuous else ())
    return policy.decide(seen or observation())


def test_without_refinement_an_action_is_a_pixel_and_a_bin():
    found = decide(Known(), continuous=False)
    np.testing.assert_array_equal(found.pick_pixel, [61, 22])
    np.testing.assert_allclose(found.place_pixel, GOAL, atol=1e-9)
    action = found.action
    assert action.pick.theta / BIN == pytest.approx(12)
    assert (action.place.theta - action.pick.theta) / BIN == pytest.approx(ROTATION)
    assert not action.stop


def test_refinement_goes_beyond_pixels_and_bins():
    networks = Known(rotation=(ROTATION + 0.4) * BIN)
    found = decide(networks, continuous=True)
    assert networks.crops == [(61, 22)]
    np.testing.assert_allclose(found.pick_pixel, PICK, atol=1e-5)
    action = found.action
    assert action.pick.theta == pytest.approx(THETA)
    rotation = (action.place.theta - action.pick.theta) / BIN
    assert 0 < rotation - ROTATION < 1
    discrete = decide(networks, continuous=False)
    assert np.abs(found.place_pixel - discrete.place_pixel).max() < 1.5


@pytest.mark.parametrize("bins", [0, ROTATION, 40, N - 1])
def test_the_offset_of_a_refined_pick_is_rotated_to_the_place(bins: int):
    """A pick that is off the crop's centre pixel moves the place by the same offset, rotated."""
    at_the_pixel, beside_it = (
        decide(Known(pick=pick, rotation=bins * BIN), continuous=True) for pick in ((61, 22), PICK)
    )
    found = beside_it.place_pixel - at_the_pixel.place_pixel
    np.testing.assert_allclose(found, rotated((0.3, 0.4), bins * BIN), atol=0.01)


def test_poses_are_in_the_world():
    found = decide(Known(), continuous=True)
    action = found.action
    for pose, pixel in ((action.pick, found.pick_pixel), (action.place, found.place_pixel)):
        assert pose.x == pytest.approx(0.3 + 0.004 * (pixel[0] + 0.5))
        assert pose.y == pytest.approx(-0.2 + 0.004 * (pixel[1] + 0.5))


def test_the_maps_agree_with_the_action():
    found = decide(Known(), continuous=True)
    assert found.pick_map.shape == found.place_map.shape == GRID.shape
    assert found.pick_map.sum() == pytest.approx(1, abs=1e-5)
    assert np.unravel_index(found.pick_map.argmax(), GRID.shape) == (61, 22)
    assert found.place_map.max() == 0
    best = np.unravel_index(found.place_map.argmax(), GRID.shape)
    assert np.abs(best - GOAL).max() <= 2
    assert found.angle_curve.shape == (N // 2,)
    assert found.angle_curve.sum() == pytest.approx(1, abs=1e-5)
    assert found.angle_curve.argmax() == 12


def test_a_method_of_discrete_angles_predicts_a_bin():
    found = decide(Known(refines_angles=False), continuous=True)
    assert found.action.pick.theta / BIN == pytest.approx(12)
    np.testing.assert_allclose(found.pick_pixel, PICK, atol=1e-5)


@pytest.mark.parametrize(
    ("log_odds", "threshold", "stop"),
    [(-2.1, -2.0, True), (-1.9, -2.0, False), (None, -2.0, False), (-99.0, None, False)],
)
def test_stops_when_the_log_odds_are_below_the_threshold(
    log_odds: float | None, threshold: float | None, stop: bool
):
    networks = Known(log_odds=log_odds)
    networks.stop_threshold = threshold
    policy = LearnedPolicy(networks, orientations=N)
    assert policy.log_odds(observation()) == log_odds
    found = policy.decide(observation())
    assert (found.stop, found.log_odds) == (stop, log_odds)
    # Even if the policy stops, the decision holds the action that the policy would have taken.
    np.testing.assert_allclose(
        found.place_pixel, GOAL + rotated((0.3, 0.4), ROTATION * BIN), atol=0.1
    )
    action = policy(observation())
    assert action == (PickPlaceAction(stop=True, reason="done") if stop else found.action)
    assert action.heights is None
    # Without the stage `StopRule`, the policy never stops.
    unasked = LearnedPolicy(networks, orientations=N, stages=[SubPixel()])
    assert unasked(observation()) == dataclasses.replace(found.action, stop=False, reason="")


@pytest.mark.parametrize(
    "pixel", [(3.0, 4.0), (3.5, 4.5), (2.7, 4.1), (0.0, 0.2), (6.0, 7.9), (5.6, 8.0), (0.5, 0.0)]
)
def test_recovers_an_interpolated_position(pixel: tuple[float, float]):
    logits = linear((7, 9), pixel)
    row, col = divmod(int(logits.argmax()), 9)
    np.testing.assert_allclose(expected_position(logits, (row, col)), pixel, atol=1e-5)


def test_a_position_does_not_depend_on_other_peaks():
    """Two objects may be equally good picks, but the mean of their positions is no good pick."""
    two = (linear((9, 9), (2, 2)).exp() + linear((9, 9), (2, 6)).exp()).log()
    np.testing.assert_allclose(expected_position(two, (2, 2)), (2, 2), atol=1e-5)


# Windows of the place volume: the first bin, the corner pixel (row, col), and the label's position
# (bin, row, col) in the window.
PLACEMENTS = [
    (10, (5, 7), (2.3, 3.6, 4.4)),
    (-4, (0, 0), (3.0, 0.0, 0.4)),
    (70, (30, 40), (5.8, 8.0, 1.25)),
]


@pytest.mark.parametrize(("first", "corner", "label"), PLACEMENTS)
def test_recovers_an_interpolated_placement(
    first: int, corner: tuple[int, int], label: tuple[float, float, float]
):
    candidate = Candidate(linear((7, 9, 9), label), first, corner)
    rotation, position = best_placement(candidate, N, continuous=True)
    expected = (first + label[0]) * BIN
    assert math.remainder(rotation - expected, math.tau) == pytest.approx(0, abs=1e-6)
    assert abs(rotation) <= math.pi
    np.testing.assert_allclose(position, np.add(corner, label[1:]), atol=1e-5)
    rotation, position = best_placement(candidate, N, continuous=False)
    nearest = np.rint(label)
    assert math.remainder(rotation - (first + nearest[0]) * BIN, math.tau) == pytest.approx(0)
    np.testing.assert_array_equal(position, corner + nearest[1:])


def plain_networks(compute_type: torch.dtype) -> Networks:
    networks = make_networks(NetworkConfig(preset="tiny"), PlainConv2d)
    networks.freeze(compute_type)
    return networks


def test_a_decision_does_not_depend_on_earlier_ones():
    policy = LearnedPolicy(plain_networks(torch.bfloat16), orientations=N)
    random = np.random.default_rng(0)
    one, other = (
        Observation(random.random((4, *GRID.shape), np.float32) / 10, GRID) for _ in range(2)
    )
    first = policy(one)
    assert policy(other) != first
    assert policy(one) == first


def test_a_read_only_image_is_accepted_and_not_changed():
    image = np.random.default_rng(0).random((4, *GRID.shape), np.float32)
    before = image.copy()
    image.flags.writeable = False
    LearnedPolicy(plain_networks(torch.float32), orientations=N)(Observation(image, GRID))
    np.testing.assert_array_equal(image, before)


class Distracted(Known):
    """Networks whose encodings match best in the padding, which is below and beside the image."""

    def encode_scene(self, image: Image) -> Tensor:
        scene = super().encode_scene(image)
        return scene + 2 * scene.roll((40, 30), (2, 3))


@pytest.mark.parametrize("continuous", [True, False])
def test_the_place_lies_in_the_image(continuous: bool):
    """The search must ignore the padding, which networks need."""
    grid = dataclasses.replace(GRID, rows=70, cols=110)
    seen = Observation(np.zeros((4, *grid.shape), np.float32), grid)
    found = decide(Distracted(), continuous=continuous, seen=seen)
    np.testing.assert_allclose(found.place_pixel, GOAL, atol=0.6)
    assert found.place_map.shape == grid.shape
    assert found.place_map.max() == 0


@pytest.mark.parametrize(
    ("orientations", "message"),
    [(24, r"at least 26 are needed \(Nyquist\)"), (37, "not a multiple of 2")],
)
def test_unsupported_orientations_are_rejected(orientations: int, message: str):
    with pytest.raises(ValueError, match=message):
        LearnedPolicy(Known(), orientations=orientations)


def test_avoids_failed_grasps():
    networks = Known()
    policy = LearnedPolicy(networks, orientations=N, stages=())
    seen = Observation(np.zeros((4, *GRID.shape), np.float32), GRID)
    first = policy(seen)
    second = policy(seen, [first.pick])
    assert math.dist((first.pick.x, first.pick.y), (second.pick.x, second.pick.y)) > 0.0099
    assert policy(seen, [PlanarPose(first.pick.x + 0.02, first.pick.y, 0.0)]) == first
