"""What the networks are given to learn: inputs, crops and labels, several objects at once."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies import networks as networks_module
from kitting_drake.policies.config import PICK_CROP
from kitting_drake.policies.images import LabelledImage, crop
from kitting_drake.policies.networks import FactoredNetworks
from tests.kitting_drake.policies.scenes import ORIENTATIONS, SIDE, config, scene

BINS = ORIENTATIONS // 2
STEP = math.tau / ORIENTATIONS


class Listening(FactoredNetworks):
    """Answers with zeros, so that the gradients tell the labels; remembers what it is shown."""

    def __init__(self) -> None:
        super().__init__(config("so2"))
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.crops = torch.zeros(0)
        self.logits = torch.zeros(0)

    def position_logits(self, image: np.ndarray, orientations: int) -> Tensor:
        self.logits = torch.zeros(image.shape[1:], requires_grad=True)
        return self.logits

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        self.crops = crops
        self.logits = torch.zeros(len(crops), orientations // 2, requires_grad=True)
        return self.logits

    def label(self) -> Tensor:
        """Of a mean of cross-entropies, after `backward`: the share of each entry."""
        assert self.logits.grad is not None
        count = 1 if self.logits.shape[0] == SIDE else len(self.logits)
        return count * (1 / self.logits.numel() - self.logits.grad)


def two_tools() -> LabelledImage:
    """A scene in which another object might be picked at bin 5, and one that has left the image."""
    return dataclasses.replace(
        scene(0),
        other_picks=np.array([[-4.0, 30.0], [30.0, 70.0]]),
        other_thetas=np.array([0.3, 5 * STEP]),
        bends=np.array([[0.1, 0.0], [9.0, 9.0], [0.3, -0.2]]),
    )


def test_inputs_are_normalised_and_padded_below_and_on_the_right():
    networks = Listening()
    image = np.random.default_rng(0).random((4, 160, 161), np.float32)
    prepared = networks.prepare(image)[0]
    assert prepared.shape == (4, 161, 161)
    mean = torch.tensor([0.0, 0.0, 0.0, 0.0])[:, None, None]
    deviation = torch.tensor([0.5, 0.5, 0.5, 0.02])[:, None, None]
    torch.testing.assert_close(prepared[:, :160], (torch.from_numpy(image) - mean) / deviation)
    assert (prepared[:, 160:] == 0).all()


def test_every_pick_in_the_image_is_a_label():
    networks, random = Listening(), np.random.default_rng(0)
    sample = two_tools()
    losses = dict(networks.losses(sample, random))
    losses["pick_position"]().backward()
    label = networks.label()
    for row, col in (sample.pick, sample.other_picks[1]):
        assert label[round(row), round(col)] == pytest.approx(0.5, abs=1e-5)
    assert label.sum() == pytest.approx(1.0, abs=1e-4)


def test_each_crop_has_the_angle_and_the_bend_of_its_own_object():
    networks, random = Listening(), np.random.default_rng(0)
    sample = networks_module.within_image(two_tools())
    pixels = [(int(sample.pick[0]) + 1, int(sample.pick[1]) - 2), (31, 69)]
    (_, angle) = dict(networks.pick_losses(sample, pixels, random)).popitem()
    angle().backward()
    bins = [round(sample.pick_theta % math.pi / STEP) % BINS, 5]
    assert networks.label().argmax(1).tolist() == bins * 2
    assert networks.label().amax(1).tolist() == pytest.approx([1.0] * 4, abs=1e-5)
    shown = [crop(sample.image, pixel, PICK_CROP) for pixel in pixels]
    shown += [sample.bent_crop(index, pixel, PICK_CROP) for index, pixel in enumerate(pixels)]
    torch.testing.assert_close(
        networks.crops, torch.cat([networks.prepare(image) for image in shown])
    )
    # The bend of the object that left the image left with it.
    np.testing.assert_array_equal(sample.bends, [[0.1, 0.0], [0.3, -0.2]])


def test_crops_lie_a_little_beside_the_label(monkeypatch: pytest.MonkeyPatch):
    sample, networks = two_tools(), Listening()
    offsets = []
    monkeypatch.setattr(networks, "place_loss", lambda _, pixel, __: offsets.append(pixel))
    for seed in range(100):
        dict(networks.losses(sample, np.random.default_rng(seed)))["place"]()
    beside = np.array(offsets) - np.rint(sample.pick)
    assert {tuple(offset) for offset in np.abs(beside)} == {
        (row, col) for row in range(3) for col in range(3)
    }


def test_the_place_is_that_of_the_pixel_that_was_picked(monkeypatch: pytest.MonkeyPatch):
    """A crop beside the label goes to beside the place, turned along."""
    networks, sample = Listening(), dataclasses.replace(scene(0), turn=math.radians(-150.0))
    told: list[Any] = []
    monkeypatch.setattr(networks, "encode_scene", lambda image: "phi")
    monkeypatch.setattr(networks, "encode_crop", lambda image, pixel: pixel)
    monkeypatch.setattr(networks_module, "place_loss", lambda *arguments: told.extend(arguments))
    row, col = (int(value) for value in sample.pick)
    networks.place_loss(sample, (row + 2, col - 1), torch.Generator())
    scene_encoding, crop_encoding, goal, turn, orientations, _ = told
    assert (scene_encoding, crop_encoding) == ("phi", (row + 2, col - 1))
    assert turn == pytest.approx(math.radians(210.0))
    cos, sin = math.cos(sample.turn), math.sin(sample.turn)
    expected = sample.place + (2 * cos + sin, 2 * sin - cos)
    assert goal == pytest.approx(expected)
    assert orientations == ORIENTATIONS
