"""The networks' training inputs, crops and labels, with several objects."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.data.images import LabelledImage, crop
from kitting_drake.policies.networks import factored as networks_module
from kitting_drake.policies.networks.architecture import PICK_CROP
from kitting_drake.policies.networks.factored import FactoredNetworks
from kitting_drake.policies.networks.losses import NOTHING_LOGIT
from tests.kitting_drake.policies.scenes import ORIENTATIONS, SIDE, config, scene

BINS = ORIENTATIONS // 2
STEP = math.tau / ORIENTATIONS


class ZeroNetworks(FactoredNetworks):
    """Networks whose logits are all zero, so that the logits' gradients reveal the labels.

    They store the last crops and logits.
    """

    def __init__(self, *, stop: bool = False) -> None:
        super().__init__(config("so2", stop=stop))
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.crops = torch.zeros(0)
        self.logits = torch.zeros(0)

    def position_logits(self, image: np.ndarray) -> Tensor:
        self.logits = torch.zeros(image.shape[1:], requires_grad=True)
        return self.logits

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        self.crops = crops
        self.logits = torch.zeros(len(crops), orientations // 2, requires_grad=True)
        return self.logits

    def label(self) -> Tensor:
        """The label of the last loss, recovered from the logits' gradient after `backward`."""
        assert self.logits.grad is not None
        count = 1 if self.logits.shape[0] == SIDE else len(self.logits)
        return count * (1 / self.logits.numel() - self.logits.grad)


def two_tools() -> LabelledImage:
    """`scene(0)` with two added picks: one outside the image, and one whose angle is bin 5."""
    return dataclasses.replace(
        scene(0),
        other_picks=np.array([[-4.0, 30.0], [30.0, 70.0]]),
        other_thetas=np.array([0.3, 5 * STEP]),
        curvatures=np.array([[0.1, 0.0], [9.0, 9.0], [0.3, -0.2]]),
    )


def test_inputs_are_normalised_and_padded_below_and_on_the_right():
    networks = ZeroNetworks()
    image = np.random.default_rng(0).random((4, 160, 161), np.float32)
    prepared = networks.prepare(image)[0]
    assert prepared.shape == (4, 161, 161)
    mean = torch.tensor([0.0, 0.0, 0.0, 0.0])[:, None, None]
    deviation = torch.tensor([0.5, 0.5, 0.5, 0.02])[:, None, None]
    torch.testing.assert_close(prepared[:, :160], (torch.from_numpy(image) - mean) / deviation)
    assert (prepared[:, 160:] == 0).all()


def test_a_stop_class_adds_the_presence_loss():
    sample = two_tools()
    losses = [
        dict(networks.losses(sample, np.random.default_rng(0)))["pick_position"]().item()
        for networks in (ZeroNetworks(), ZeroNetworks(stop=True))
    ]
    # With zero logits, the odds of a pick are the number of pixels / exp(NOTHING_LOGIT).
    odds = SIDE**2 / math.exp(NOTHING_LOGIT)
    assert losses[1] - losses[0] == pytest.approx(math.log1p(1 / odds), rel=1e-4)
    stopping = ZeroNetworks(stop=True)
    loss = stopping.stop_loss(sample.image, np.random.default_rng(0)).item()
    assert loss == pytest.approx(math.log1p(odds), rel=1e-4)
    prediction = stopping.predict_pick(sample.image, ORIENTATIONS)
    assert prediction.log_odds == pytest.approx(math.log(odds), rel=1e-4)
    assert ZeroNetworks().predict_pick(sample.image, ORIENTATIONS).log_odds is None


def test_every_pick_inside_the_image_is_a_label():
    networks, random = ZeroNetworks(), np.random.default_rng(0)
    sample = two_tools()
    losses = dict(networks.losses(sample, random))
    losses["pick_position"]().backward()
    label = networks.label()
    for row, col in (sample.pick, sample.other_picks[1]):
        assert label[round(row), round(col)] == pytest.approx(0.5, abs=1e-5)
    assert label.sum() == pytest.approx(1.0, abs=1e-4)


def test_each_crop_has_the_angle_and_curvature_of_its_own_object():
    networks, random = ZeroNetworks(), np.random.default_rng(0)
    sample = networks_module.within_image(two_tools())
    pixels = [(int(sample.pick[0]) + 1, int(sample.pick[1]) - 2), (31, 69)]
    (_, angle) = dict(networks.pick_losses(sample, pixels, random)).popitem()
    angle().backward()
    bins = [round(sample.pick_theta % math.pi / STEP) % BINS, 5]
    assert networks.label().argmax(1).tolist() == bins * 2
    assert networks.label().amax(1).tolist() == pytest.approx([1.0] * 4, abs=1e-5)
    shown = [crop(sample.image, pixel, PICK_CROP) for pixel in pixels]
    shown += [sample.curved_crop(index, pixel, PICK_CROP) for index, pixel in enumerate(pixels)]
    torch.testing.assert_close(
        networks.crops, torch.cat([networks.prepare(image) for image in shown])
    )
    # The object outside the image is dropped with its curvature.
    np.testing.assert_array_equal(sample.curvatures, [[0.1, 0.0], [0.3, -0.2]])


def test_crops_are_centred_near_the_label(monkeypatch: pytest.MonkeyPatch):
    sample, networks = two_tools(), ZeroNetworks()
    offsets = []
    monkeypatch.setattr(networks, "place_loss", lambda _, pixel, __: offsets.append(pixel))
    for seed in range(100):
        dict(networks.losses(sample, np.random.default_rng(seed)))["place"]()
    beside = np.array(offsets) - np.rint(sample.pick)
    assert {tuple(offset) for offset in np.abs(beside)} == {
        (row, col) for row in range(3) for col in range(3)
    }


def test_the_place_label_follows_the_crop_s_centre(monkeypatch: pytest.MonkeyPatch):
    """If the crop's centre is off the pick, the label is off the place by the rotated offset."""
    networks, sample = ZeroNetworks(), dataclasses.replace(scene(0), rotation=math.radians(-150.0))
    told: list[Any] = []
    monkeypatch.setattr(networks, "encode_scene", lambda image: "phi")
    monkeypatch.setattr(networks, "encode_crop", lambda image, pixel: pixel)
    monkeypatch.setattr(networks_module, "place_loss", lambda *arguments: told.extend(arguments))
    row, col = (int(value) for value in sample.pick)
    networks.place_loss(sample, (row + 2, col - 1), 0)
    scene_encoding, crop_encoding, goal, rotation, orientations, _ = told
    assert (scene_encoding, crop_encoding) == ("phi", (row + 2, col - 1))
    assert rotation == pytest.approx(math.radians(210.0))
    cos, sin = math.cos(sample.rotation), math.sin(sample.rotation)
    expected = sample.place + (2 * cos + sin, 2 * sin - cos)
    assert goal == pytest.approx(expected)
    assert orientations == ORIENTATIONS
