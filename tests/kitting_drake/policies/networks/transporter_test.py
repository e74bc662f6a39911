import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.data.images import Image, LabelledImage, rotation_matrix
from kitting_drake.policies.networks.architecture import PLACE_CROP, PRESETS, NetworkConfig
from kitting_drake.policies.networks.layers.correlation import KERNEL, cross_correlation, lift
from kitting_drake.policies.networks.losses import (
    interpolate_label,
    joint_loss,
    log_odds,
    presence_loss,
)
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.resnet import PlainLayer, ResNet
from kitting_drake.policies.networks.transporter import (
    TransporterNetworks,
    canvas_shape,
    draw_bins,
    encodings_per_decision,
    rotated,
    rotated_crops,
)
from kitting_drake.policies.networks.weights import load_networks, save_weights
from kitting_drake.policies.training.training_step import Trainer

N = 8
STEP = math.tau / N
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
        rotation=2.1,
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
def test_a_point_is_rotated_about_the_centre(angle: float):
    shape = (60, 101)
    point = np.array([22.3, 61.8])
    canvas = canvas_shape(shape, angle)
    image = rotated(blob(shape, (point[0], point[1])), angle, canvas)
    middle, canvas_middle = (np.array(sides) / 2 - 0.5 for sides in (shape, canvas))
    expected = rotation_matrix(angle) @ (point - middle) + canvas_middle
    assert image.shape[2:] == canvas
    np.testing.assert_allclose(centroid(image), expected, atol=1e-3)
    back = rotated(image, -angle, shape)
    np.testing.assert_allclose(centroid(back), point, atol=1e-3)


def test_a_rotation_by_90_degrees_is_exact():
    image = torch.randn(1, 4, 8, 13)
    assert canvas_shape((8, 13), math.pi / 2) == (13, 8)
    found = rotated(image, math.pi / 2, (13, 8))
    torch.testing.assert_close(found, image.rot90(1, (2, 3)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_canvas_holds_every_pixel_with_little_margin(angle: float):
    shape = (20, 31)
    canvas = np.array(canvas_shape(shape, angle))
    half = np.array(shape) / 2 - 0.5
    corners = np.array([(a, b) for a in (-1, 1) for b in (-1, 1)]) * half
    needed = 2 * np.abs(corners @ rotation_matrix(angle).T).max(0) + 1
    assert (canvas > needed - 1e-5).all()
    assert (canvas < needed + 1).all()


def test_has_43_layers():
    network = ResNet(4, 3, PRESETS["tiny"].resnet)
    layers = [name for name, item in network.named_modules() if isinstance(item, PlainLayer)]
    assert sum("shortcut" not in name for name in layers) == 43
    image = torch.randn(1, 4, 33, 49)
    assert network(image).shape == (1, 3, 33, 49)
    # Of the four stages, three halve the image.
    sides = []
    halved = network.stem(image)
    for stage in network.down:
        halved = stage(halved)
        sides.append(tuple(halved.shape[2:]))
    assert sides == [(33, 49), (17, 25), (9, 13), (5, 7)]


@torch.no_grad()
def test_the_volume_is_equivariant_to_rotations_by_90_degrees():
    networks = transporter().eval()
    image = sample().image
    volume = networks.pick_volume(image, N)
    assert volume.shape == (N // 2, *image.shape[1:])
    # The bins cover 0 to pi. Compare those that stay below pi after the rotation: the network
    # does not know that the angle pi is the same as 0.
    found = networks.pick_volume(np.rot90(image, axes=(1, 2)).copy(), N)[N // 4 :]
    expected = volume[: N // 4].rot90(1, (1, 2))
    assert expected.std() > 1e-3
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


@torch.no_grad()
def test_picks_the_maximum_of_the_volume():
    networks = transporter().eval()
    image = sample().image
    volume = networks.pick_volume(image, N)
    picking = networks.predict_pick(image, N)
    row, col = divmod(int(picking.position.argmax()), picking.position.shape[1])
    angles = picking.angle((row, col)).logits
    assert angles.shape == (N // 2,)
    assert angles.max() == volume.max()
    # The same networks serve any N: every second bin of N = 16 is a bin of N = 8.
    finer = networks.predict_pick(image, 16).angle((row, col)).logits
    torch.testing.assert_close(finer[::2], angles)
    with pytest.raises(ValueError, match="even"):
        networks.check_orientations(9)


@torch.no_grad()
def test_position_and_angle_share_one_volume_that_is_not_cached(
    monkeypatch: pytest.MonkeyPatch,
):
    networks = transporter().eval()
    image = sample().image.copy()
    computed = []
    scores = networks._pick_scores

    def watched(image: Image, theta: float) -> torch.Tensor:
        computed.append(theta)
        return scores(image, theta)

    monkeypatch.setattr(networks, "_pick_scores", watched)
    before = networks.predict_pick(image, N)
    angles = before.angle((20, 30)).logits
    assert len(computed) == N // 2
    assert angles.max() == before.position[20, 30]
    # The networks must notice that the same array holds another image.
    image[:] = image[:, ::-1].copy()
    assert not torch.equal(networks.predict_pick(image, N).position, before.position)


@pytest.mark.parametrize("angle", ANGLES)
def test_crops_are_those_of_the_rotated_scene(angle: float):
    """The scene is rotated about the pick, which becomes the crop's centre."""
    pixel, point = (50, 70), np.array([58.0, 49.0])
    scene = blob((101, 121), (point[0], point[1]))
    (found,) = rotated_crops(scene, pixel, [angle])
    middle = np.full(2, PLACE_CROP // 2)
    expected = middle + rotation_matrix(angle) @ (point - pixel)
    np.testing.assert_allclose(centroid(found[None]), expected, atol=1e-3)


def test_the_corners_of_a_rotated_crop_are_filled():
    scene = torch.ones(1, 4, 161, 161)
    crops = rotated_crops(scene, (80, 80), [0.0, math.radians(30), math.radians(45)])
    assert crops.shape == (3, 4, PLACE_CROP, PLACE_CROP)
    torch.testing.assert_close(crops, torch.ones_like(crops))


@torch.no_grad()
@pytest.mark.parametrize("orientations", [8, 36])
def test_places_at_the_maximum_of_the_correlation_with_all_rotated_crops(orientations: int):
    networks = transporter().eval()
    image, pixel = sample().image, (14, 22)
    rows, cols = image.shape[1:]
    placing = networks.predict_place(image, pixel, orientations)
    angles = [i * math.tau / orientations for i in range(orientations)]
    kernels = networks.encode_crops(image, pixel, angles)
    # Encoding a rotated crop differs from rotating the crop's encoding.
    rotated_encodings = lift(networks.encode_crop(image, pixel), torch.tensor(angles), KERNEL)
    assert (kernels[1:] - rotated_encodings[1:]).norm() > 0.01 * kernels[1:].norm()
    volume = cross_correlation(networks.encode_scene(image), kernels)[:, :rows, :cols]
    score, rotation, row, col = placing.candidates[0].best()
    assert score == pytest.approx(float(volume.max()), rel=1e-4)
    assert volume[rotation % orientations, row, col] == pytest.approx(score, rel=1e-4)
    torch.testing.assert_close(placing.score_map, volume.amax(0), rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_more_than_36_rotations_are_searched_from_coarse_to_fine(
    monkeypatch: pytest.MonkeyPatch,
):
    networks = transporter().eval()
    image, pixel = sample().image, (14, 22)
    encoded = []
    encode = networks.encode_crops

    def watched(image: Image, pixel: tuple[int, int], angles: list[float]) -> torch.Tensor:
        encoded.extend(angles)
        return encode(image, pixel, angles)

    monkeypatch.setattr(networks, "encode_crops", watched)
    placing = networks.predict_place(image, pixel, 180)
    assert len(encoded) == encodings_per_decision(180) == 36 + 3 * 11
    best = placing.candidates[0]
    score, rotation, row, col = best.best()
    assert score >= placing.score_map.max() - 1e-4
    # The best candidate's score is the exact score of its bin and pixel.
    kernels = encode(image, pixel, [rotation * math.tau / 180])
    volume = cross_correlation(networks.encode_scene(image), kernels)
    assert volume[0, row, col] == pytest.approx(score, rel=1e-4)


def test_drawn_bins_represent_all_bins():
    step = math.tau / 180
    drawn = draw_bins({89, 0, 30}, 90, step, np.random.default_rng(0))
    assert [drawn[bin_] for bin_ in (0, 30, 89)] == [0, 0, 0]
    assert len(drawn) == 7
    assert sum(math.exp(weight) for weight in drawn.values()) == pytest.approx(90)
    near = [min(abs(bin_ - 30), bin_, 89 - bin_) <= 5 for bin_ in drawn if bin_ not in (0, 30, 89)]
    assert near == [True, True, False, False]
    everything = draw_bins({0, 1}, 4, math.tau / 8, np.random.default_rng(0))
    assert everything == dict.fromkeys(range(4), 0.0)
    # Place bins are cyclic over a full rotation.
    drawn = draw_bins({0}, 180, step, np.random.default_rng(0))
    near = [min(bin_, 180 - bin_) <= 5 for bin_ in drawn if bin_]
    assert near == [True, True, False, False]
    # For a final observation, which has no labels, bins are drawn too.
    drawn = draw_bins(set(), 90, step, np.random.default_rng(0))
    assert sum(math.exp(weight) for weight in drawn.values()) == pytest.approx(90)


@pytest.mark.parametrize(
    ("labels", "rotations", "near", "far"),
    [
        # Of 36 bins, only those next to a label count as near it; all others count as far.
        ({3, 4}, 9, 2, 5),
        ({3, 4}, 18, 2, 14),
        ({3, 4}, 36, 2, 32),
        ({3, 4}, 99, 2, 32),
        # At least the default number of bins is drawn, even if fewer are requested.
        ({3, 4}, 1, 2, 2),
        ({3}, 9, 2, 6),
        (set(), 9, 0, 9),
    ],
)
def test_the_requested_number_of_bins_is_drawn(
    labels: set[int], rotations: int, near: int, far: int
):
    drawn = draw_bins(labels, 36, math.tau / 36, np.random.default_rng(0), rotations)
    assert labels <= set(drawn)
    others = set(drawn) - labels
    assert len({bin_ for bin_ in others if {bin_ - 1, bin_ + 1} & labels}) == near
    assert len(others) == near + far
    assert sum(math.exp(weight) for weight in drawn.values()) == pytest.approx(36)


def test_all_bins_can_be_drawn_even_if_most_are_near():
    assert len(draw_bins({0, 40}, 90, math.tau / 180, np.random.default_rng(0), 90)) == 90
    few = draw_bins({0, 1}, 8, math.tau / 180, np.random.default_rng(0), 8)
    assert few == dict.fromkeys(range(8), 0.0)


def test_with_all_bins_the_losses_are_exact():
    networks = transporter(dataclasses.replace(TINY, stop=True))
    networks.rotations = N
    one = dataclasses.replace(sample(), other_picks=np.zeros((0, 2)), other_thetas=np.zeros(0))
    (name, pick_loss), _ = networks.losses(one, np.random.default_rng(0))
    assert name == networks.picking == "pick"
    volume = networks.pick_volume(one.image, N)
    bins = interpolate_label(one.pick_theta / STEP, N // 2, cyclic=True)
    odds = log_odds(volume, N // 2)
    expected = joint_loss(volume, (bins, (14.3, 22.6))) + presence_loss(odds, present=True)
    torch.testing.assert_close(pick_loss(), expected)
    with torch.no_grad():
        assert networks.predict_pick(one.image, N).log_odds == pytest.approx(odds.item(), rel=1e-5)
    torch.testing.assert_close(
        networks.stop_loss(one.image, np.random.default_rng(0)), presence_loss(odds, present=False)
    )

    pixel = (15, 22)
    kernels = networks.encode_crops(one.image, pixel, [i * STEP for i in range(N)])
    volume = cross_correlation(networks.encode_scene(one.image), kernels)
    row, col = one.place + rotation_matrix(one.rotation) @ (pixel - one.pick)
    bins = interpolate_label(one.rotation / STEP, N, cyclic=True)
    torch.testing.assert_close(
        networks.place_loss(one, pixel, 0), joint_loss(volume, (bins, (row, col)))
    )


def losses(steps: int) -> list[dict[str, float]]:
    torch.manual_seed(1)
    trainer = Trainer(transporter(), seed=0, learning_rate=1e-3)
    found = []
    for _ in range(steps):
        # Random draws depend on the step number. At number 0 the scene always moves the same way.
        trainer.step_count = 0
        found.append(trainer.step([sample()]))
    return found


@pytest.mark.slow
def test_learns_a_sample_reproducibly():
    found = losses(5)
    assert set(found[0]) == {"pick", "place"}
    for name in found[0]:
        assert found[-1][name] < found[0][name]
    assert losses(2) == found[:2]


@torch.no_grad()
def test_loads_from_a_file(tmp_path: Path):
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
def test_computes_in_bfloat16():
    networks = transporter().eval()
    image = sample().image
    expected = networks.pick_volume(image, N)
    networks.compute_type = torch.bfloat16
    found = networks.pick_volume(image.copy(), N)
    assert found.dtype == torch.float32
    assert (found - expected).norm() < 0.1 * expected.norm()
