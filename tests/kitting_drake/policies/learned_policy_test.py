import dataclasses
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.config import PLACE_CROP, NetworkConfig
from kitting_drake.policies.correlation import Candidate
from kitting_drake.policies.images import Image
from kitting_drake.policies.learned_policy import (
    Decision,
    LearnedPolicy,
    best_placement,
    expected_position,
)
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import Networks
from kitting_drake.policies.steerable import PlainConv2d
from systems.signals import Observation, PixelGrid

# No defaults, no two numbers alike.
GRID = PixelGrid(x_min=0.3, y_min=-0.2, resolution=0.004, rows=97, cols=129, z_min=0.02, z_max=0.3)
PICK = (61.3, 22.4)
GOAL = np.array([40, 90])
N = 72
BIN = math.tau / N
TURN = 19
THETA = math.radians(62.0)
ARMS = ((0, 0), (0, 18), (9, 0))
"""Where (row, col) from the pick the encodings have their blobs, each in a channel of its own."""


def blob(shape: tuple[int, int], centre: tuple[float, float] | NDArray[np.float64]) -> Tensor:
    row, col = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    return torch.exp(-((row - centre[0]) ** 2 + (col - centre[1]) ** 2) / 8)


def linear(shape: tuple[int, ...], label: tuple[float, ...]) -> Tensor:
    """Logits of a network that has learned a label between entries, spread linearly."""
    offsets = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    shares = [(1 - (n - at).abs()).clamp(min=0) for n, at in zip(offsets, label, strict=True)]
    return torch.stack(shares).prod(0).double().log().float()


def turned(vector: tuple[float, float] | NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """A (row, col) vector turned counter-clockwise about world +z; rows run along x, cols y."""
    row, col = vector
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * row - sin * col, sin * row + cos * col])


class Known(Networks):
    """Says what it is told to; its encodings fit at GOAL and nowhere else."""

    def __init__(
        self, *, pick: tuple[float, float] = PICK, theta: float = THETA, turn: float = TURN * BIN
    ) -> None:
        super().__init__(NetworkConfig(preset="tiny"))
        self._pick, self._theta, self._turn = pick, theta, turn
        self.crops: list[tuple[int, int]] = []

    def position_logits(self, image: Image, orientations: int) -> Tensor:
        return linear(image.shape[1:], self._pick)

    def angle_logits(self, image: Image, pixel: tuple[int, int], orientations: int) -> Tensor:
        angles = torch.arange(orientations // 2) * (math.tau / orientations)
        return 9 * torch.cos(2 * (angles - self._theta))

    def angle_answer(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> tuple[Tensor, float | None]:
        return self.angle_logits(image, pixel, orientations), self._theta

    def encode_scene(self, image: Image) -> Tensor:
        ends = [GOAL + turned(arm, self._turn) for arm in ARMS]
        return 99 * torch.stack([blob(GRID.shape, end) for end in ends])[None]

    def encode_crop(self, image: Image, pixel: tuple[int, int]) -> Tensor:
        self.crops.append(pixel)
        middle = PLACE_CROP // 2
        shape = (PLACE_CROP, PLACE_CROP)
        return torch.stack([blob(shape, np.add(arm, middle)) for arm in ARMS])[None]


def observation() -> Observation:
    return Observation(np.zeros((4, *GRID.shape), np.float32), GRID)


def decide(networks: Networks, *, continuous: bool, seen: Observation | None = None) -> Decision:
    policy = LearnedPolicy(networks, orientations=N, continuous=continuous)
    return policy.decide(seen or observation())


def test_the_discrete_answer_is_a_pixel_and_a_bin():
    found = decide(Known(), continuous=False)
    np.testing.assert_array_equal(found.pick_pixel, [61, 22])
    np.testing.assert_allclose(found.place_pixel, GOAL, atol=1e-9)
    action = found.action
    assert action.pick.theta / BIN == pytest.approx(12)
    assert (action.place.theta - action.pick.theta) / BIN == pytest.approx(TURN)
    assert not action.stop


def test_the_continuous_answer_lies_between_them():
    networks = Known(turn=(TURN + 0.4) * BIN)
    found = decide(networks, continuous=True)
    assert networks.crops == [(61, 22)]
    np.testing.assert_allclose(found.pick_pixel, PICK, atol=1e-5)
    action = found.action
    assert action.pick.theta == pytest.approx(THETA)
    turn = (action.place.theta - action.pick.theta) / BIN
    assert 0 < turn - TURN < 1
    discrete = decide(networks, continuous=False)
    assert np.abs(found.place_pixel - discrete.place_pixel).max() < 1.5


@pytest.mark.parametrize("turn", [0, TURN, 40, N - 1])
def test_the_place_takes_over_how_far_the_pick_is_beside_its_pixel(turn: int):
    """What is told of the crop's middle is carried over to the pick, turned as the object is."""
    at_the_pixel, beside_it = (
        decide(Known(pick=pick, turn=turn * BIN), continuous=True) for pick in ((61, 22), PICK)
    )
    found = beside_it.place_pixel - at_the_pixel.place_pixel
    np.testing.assert_allclose(found, turned((0.3, 0.4), turn * BIN), atol=0.01)


def test_poses_are_in_the_world():
    found = decide(Known(), continuous=True)
    action = found.action
    for pose, pixel in ((action.pick, found.pick_pixel), (action.place, found.place_pixel)):
        assert pose.x == pytest.approx(0.3 + 0.004 * (pixel[0] + 0.5))
        assert pose.y == pytest.approx(-0.2 + 0.004 * (pixel[1] + 0.5))


def test_the_maps_say_what_the_answer_was_read_from():
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


def test_a_method_without_angles_between_bins_answers_with_a_bin(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Known, "angle_answer", Networks.angle_answer)
    found = decide(Known(), continuous=True)
    assert found.action.pick.theta / BIN == pytest.approx(12)
    np.testing.assert_allclose(found.pick_pixel, PICK, atol=1e-5)


@pytest.mark.parametrize(
    "pixel", [(3.0, 4.0), (3.5, 4.5), (2.7, 4.1), (0.0, 0.2), (6.0, 7.9), (5.6, 8.0), (0.5, 0.0)]
)
def test_a_position_spread_bilinearly_is_found_again(pixel: tuple[float, float]):
    logits = linear((7, 9), pixel)
    row, col = divmod(int(logits.argmax()), 9)
    np.testing.assert_allclose(expected_position(logits, (row, col)), pixel, atol=1e-5)


def test_a_position_is_not_drawn_to_what_lies_elsewhere():
    """Two objects may be picked alike: between them is neither."""
    two = (linear((9, 9), (2, 2)).exp() + linear((9, 9), (2, 6)).exp()).log()
    np.testing.assert_allclose(expected_position(two, (2, 2)), (2, 2), atol=1e-5)


# First bin, corner, and where the label is in them.
PLACEMENTS = [
    (10, (5, 7), (2.3, 3.6, 4.4)),
    (-4, (0, 0), (3.0, 0.0, 0.4)),
    (70, (30, 40), (5.8, 8.0, 1.25)),
]


@pytest.mark.parametrize(("first", "corner", "label"), PLACEMENTS)
def test_a_placement_spread_linearly_is_found_again(
    first: int, corner: tuple[int, int], label: tuple[float, float, float]
):
    candidate = Candidate(linear((7, 9, 9), label), first, corner)
    turn, position = best_placement(candidate, N, continuous=True)
    assert math.remainder(turn - (first + label[0]) * BIN, math.tau) == pytest.approx(0, abs=1e-6)
    assert abs(turn) <= math.pi
    np.testing.assert_allclose(position, np.add(corner, label[1:]), atol=1e-5)
    turn, position = best_placement(candidate, N, continuous=False)
    nearest = np.rint(label)
    assert math.remainder(turn - (first + nearest[0]) * BIN, math.tau) == pytest.approx(0)
    np.testing.assert_array_equal(position, corner + nearest[1:])


def plain_networks(compute_type: torch.dtype) -> Networks:
    networks = make_networks(NetworkConfig(preset="tiny"), PlainConv2d).requires_grad_(False)
    networks.compute_type = compute_type
    return networks


def test_what_was_asked_before_does_not_matter():
    """Of networks that compute in another type than the one that their weights come in."""
    policy = LearnedPolicy(plain_networks(torch.bfloat16), orientations=N)
    random = np.random.default_rng(0)
    one, other = (
        Observation(random.random((4, *GRID.shape), np.float32) / 10, GRID) for _ in range(2)
    )
    first = policy(one)
    assert policy(other) != first
    assert policy(one) == first


def test_an_image_that_may_not_be_written_to_is_left_as_it_is():
    image = np.random.default_rng(0).random((4, *GRID.shape), np.float32)
    before = image.copy()
    image.flags.writeable = False
    LearnedPolicy(plain_networks(torch.float32), orientations=N)(Observation(image, GRID))
    np.testing.assert_array_equal(image, before)


class Distracted(Known):
    """Its encodings fit best where nothing was seen: below and beside the image."""

    def encode_scene(self, image: Image) -> Tensor:
        scene = super().encode_scene(image)
        return scene + 2 * scene.roll((40, 30), (2, 3))


@pytest.mark.parametrize("continuous", [True, False])
def test_the_place_lies_in_the_image(continuous: bool):
    """The networks see it padded to sides that they can halve."""
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
def test_an_n_that_the_networks_cannot_answer_is_refused(orientations: int, message: str):
    with pytest.raises(ValueError, match=message):
        LearnedPolicy(Known(), orientations=orientations)


def test_who_watches_is_told_of_every_decision():
    told: list[tuple[Observation, Decision]] = []
    policy = LearnedPolicy(
        Known(), orientations=N, watch=lambda seen, decision: told.append((seen, decision))
    )
    seen = observation()
    action = policy(seen)
    ((observed, decision),) = told
    assert observed is seen
    assert decision.action is action
