import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.config import PRESETS, NetworkConfig
from kitting_drake.policies.images import Image, LabelledImage, rotation
from kitting_drake.policies.losses import joint_loss, spread
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.training import Trainer
from kitting_drake.policies.transporter import (
    PlainLayer,
    ResNet,
    TransporterNetworks,
    canvas_shape,
    draw_bins,
    turned,
)
from kitting_drake.policies.weights import load_networks, save_weights

N = 8
TINY = NetworkConfig(method="transporter", preset="tiny", orientations=N)
ANGLES = [0.0, 0.3, math.pi / 2, 2.0, -0.7, 4.0]


def transporter(config: NetworkConfig = TINY) -> TransporterNetworks:
    networks = make_networks(config)
    assert isinstance(networks, TransporterNetworks)
    return networks


def sample() -> LabelledImage:
    image = np.random.default_rng(0).random((4, 33, 41), np.float32)
    return LabelledImage(
        image=image,
        pick=np.array([14.3, 22.6]),
        pick_theta=0.7,
        place=np.array([20.2, 10.1]),
        turn=2.1,
        other_picks=np.array([[20.0, 12.5]]),
        other_thetas=np.array([3.0]),
    )


def blob(shape: tuple[int, int], centre: tuple[float, float]) -> Tensor:
    row, col = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    return torch.exp(-((row - centre[0]) ** 2 + (col - centre[1]) ** 2) / 18)[None, None].double()


def centroid(image: Tensor) -> Tensor:
    axes = map(torch.arange, image.shape[2:])
    where = torch.stack(torch.meshgrid(*axes, indexing="ij")).double()
    return (image[0] * where).sum((1, 2)) / image.sum()


@pytest.mark.parametrize("angle", ANGLES)
def test_a_point_turns_about_the_middle(angle: float):
    shape = (60, 101)
    point = np.array([22.3, 61.8])
    canvas = canvas_shape(shape, angle)
    image = turned(blob(shape, (point[0], point[1])), angle, canvas)
    middle, canvas_middle = (np.array(sides) / 2 - 0.5 for sides in (shape, canvas))
    expected = rotation(angle) @ (point - middle) + canvas_middle
    assert image.shape[2:] == canvas
    np.testing.assert_allclose(centroid(image), expected, atol=1e-3)
    back = turned(image, -angle, shape)
    np.testing.assert_allclose(centroid(back), point, atol=1e-3)


def test_a_quarter_turn_is_exact():
    image = torch.randn(1, 4, 8, 13)
    assert canvas_shape((8, 13), math.pi / 2) == (13, 8)
    found = turned(image, math.pi / 2, (13, 8))
    torch.testing.assert_close(found, image.rot90(1, (2, 3)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_canvas_holds_every_pixel_and_hardly_more(angle: float):
    shape = (20, 31)
    canvas = np.array(canvas_shape(shape, angle))
    half = np.array(shape) / 2 - 0.5
    corners = np.array([(a, b) for a in (-1, 1) for b in (-1, 1)]) * half
    needed = 2 * np.abs(corners @ rotation(angle).T).max(0) + 1
    assert (canvas > needed - 1e-5).all()
    assert (canvas < needed + 1).all()


def test_has_43_layers():
    network = ResNet(4, 3, PRESETS["tiny"].resnet)
    layers = [name for name, item in network.named_modules() if isinstance(item, PlainLayer)]
    assert sum("shortcut" not in name for name in layers) == 43
    image = torch.randn(1, 4, 33, 49)
    assert network(image).shape == (1, 3, 33, 49)
    # Strides of two at three stages.
    sides = []
    halved = network.stem(image)
    for stage in network.down:
        halved = stage(halved)
        sides.append(tuple(halved.shape[2:]))
    assert sides == [(33, 49), (17, 25), (9, 13), (5, 7)]


@torch.no_grad()
def test_the_volume_turns_by_quarters_with_the_scene():
    networks = transporter().eval()
    image = sample().image
    volume = networks.pick_volume(image, N)
    assert volume.shape == (N // 2, *image.shape[1:])
    # Bins that a quarter turn takes beyond half a turn are seen upside down by ordinary networks.
    found = networks.pick_volume(np.rot90(image, axes=(1, 2)).copy(), N)[N // 4 :]
    expected = volume[: N // 4].rot90(1, (1, 2))
    assert expected.std() > 1e-3
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


@torch.no_grad()
def test_picks_the_best_of_the_volume():
    networks = transporter().eval()
    image = sample().image
    volume = networks.pick_volume(image, N)
    logits = networks.position_logits(image, N)
    row, col = divmod(int(logits.argmax()), logits.shape[1])
    angles = networks.angle_logits(image, (row, col), N)
    assert angles.shape == (N // 2,)
    assert angles.max() == volume.max()
    # Its weights know nothing of N.
    assert networks.angle_logits(image, (row, col), 36).shape == (18,)
    torch.testing.assert_close(networks.angle_logits(image, (row, col), 16)[::2], angles)
    with pytest.raises(ValueError, match="even"):
        networks.check_orientations(9)


@torch.no_grad()
def test_a_decision_looks_once_and_the_next_one_anew(monkeypatch: pytest.MonkeyPatch):
    networks = transporter().eval()
    image = sample().image.copy()
    looks = []
    scores = networks._scores

    def look(image: Image, theta: float) -> torch.Tensor:
        looks.append(theta)
        return scores(image, theta)

    monkeypatch.setattr(networks, "_scores", look)
    before = networks.position_logits(image, N)
    angles = networks.angle_logits(image, (20, 30), N)
    assert len(looks) == N // 2
    assert angles.max() == before[20, 30]
    # A camera may fill the same buffer again.
    image[:] = image[:, ::-1].copy()
    assert not torch.equal(networks.position_logits(image, N), before)
    state = {name: value + 0.1 for name, value in networks.state_dict().items()}
    networks.load_state_dict(state)
    assert not torch.equal(networks.angle_logits(image, (20, 30), N), angles)


def test_draws_stand_for_all_turns():
    step = math.tau / 180
    drawn = draw_bins({89, 0, 30}, 90, step, np.random.default_rng(0))
    assert [drawn[bin_] for bin_ in (0, 30, 89)] == [0, 0, 0]
    assert len(drawn) == 7
    assert sum(math.exp(weight) for weight in drawn.values()) == pytest.approx(90)
    apart = [min(abs(bin_ - 30), bin_, 89 - bin_) <= 5 for bin_ in drawn if bin_ not in (0, 30, 89)]
    assert apart == [True, True, False, False]
    everything = draw_bins({0, 1}, 4, math.tau / 8, np.random.default_rng(0))
    assert everything == dict.fromkeys(range(4), 0.0)


def test_the_loss_is_that_of_the_whole_volume_where_all_turns_are_drawn():
    networks = transporter()
    one = dataclasses.replace(sample(), other_picks=np.zeros((0, 2)), other_thetas=np.zeros(0))
    (name, loss), _ = networks.losses(one, np.random.default_rng(0))
    assert name == "pick"
    bins = spread(one.pick_theta / (math.tau / N), N // 2, cyclic=True)
    expected = joint_loss(networks.pick_volume(one.image, N), (bins, tuple(one.pick)))
    assert float(loss().detach()) == pytest.approx(float(expected.detach()), rel=1e-5)


def losses(steps: int) -> list[dict[str, float]]:
    torch.manual_seed(1)
    trainer = Trainer(transporter(), seed=0, learning_rate=1e-3)
    found = []
    for _ in range(steps):
        # The same draws, so the same motion of the scene.
        trainer.step_count = 0
        found.append(trainer.step([sample()]))
    return found


def test_learns_a_sample_and_the_same_for_a_seed():
    found = losses(5)
    assert set(found[0]) == {"pick", "place"}
    for name in found[0]:
        assert found[-1][name] < found[0][name]
    assert losses(2) == found[:2]


@torch.no_grad()
def test_comes_back_from_a_file(tmp_path: Path):
    networks = transporter().eval()
    path = tmp_path / "policy.safetensors"
    save_weights(path, networks, {})
    loaded = load_networks(path)
    assert loaded.config == TINY
    image = sample().image
    for ask in (
        lambda item: item.pick_volume(image, N),
        lambda item: item.encode_scene(image),
        lambda item: item.encode_crop(image, (14, 22)),
    ):
        torch.testing.assert_close(ask(loaded), ask(networks))


@torch.no_grad()
def test_computes_in_sixteen_bits():
    networks = transporter().eval()
    image = sample().image
    expected = networks.pick_volume(image, N)
    networks.compute_type = torch.bfloat16
    found = networks.pick_volume(image.copy(), N)
    assert found.dtype == torch.float32
    assert (found - expected).norm() < 0.1 * expected.norm()
