import dataclasses
import math

import numpy as np
import pytest

from kitting_drake.policies.data.images import (
    LabelledImage,
    Motion,
    augment,
    crop,
    move,
    reflect,
    rotation_matrix,
)
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose

ROWS, COLS = 61, 91
MIDDLE = np.array([(ROWS - 1) / 2, (COLS - 1) / 2])


def marked(pick: tuple[float, float], place: tuple[float, float]) -> LabelledImage:
    """An image with round hills at its labels: 1 m high at the pick, 2 m high at the place."""
    row, col = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
    height = sum(
        top * np.exp(-((row - at[0]) ** 2 + (col - at[1]) ** 2) / 8)
        for top, at in ((1.0, pick), (2.0, place))
    )
    image = np.concatenate([np.full((3, ROWS, COLS), 0.5), height[None]]).astype(np.float32)
    return LabelledImage(image, np.array(pick), 0.3, np.array(place), 1.1)


SAMPLE = marked((20.0, 30.0), (38.25, 55.5))


def hill(sample: LabelledImage, near: np.ndarray) -> np.ndarray:
    """The centre (row, col) of the hill near a position."""
    row, col = np.rint(near).astype(int)
    rows, cols = np.arange(row - 6, row + 7), np.arange(col - 6, col + 7)
    weights = sample.image[3][np.ix_(rows, cols)]
    total = weights.sum()
    return np.array([(weights.sum(1) * rows).sum(), (weights.sum(0) * cols).sum()]) / total


def test_rotations_are_counter_clockwise_with_row_0_on_top():
    down, right = np.array([1.0, 0]), np.array([0, 1.0])
    np.testing.assert_allclose(rotation_matrix(math.pi / 2) @ down, right, atol=1e-12)
    image = np.zeros((3, 3))
    # A counter-clockwise rotation moves this pixel from below the centre to the right of it.
    image[2, 1] = 1
    assert np.rot90(image)[1, 2] == 1


def test_labels_of_an_action():
    grid = PixelGrid()
    pick, place = grid.to_world((40.25, 100.5)), grid.to_world((90.0, 200.0))
    action = PickPlaceAction(PlanarPose(*pick, 2.0), PlanarPose(*place, -1.5))
    sample = LabelledImage.from_action(np.zeros((4, *grid.shape), np.float32), action, grid)
    np.testing.assert_allclose(sample.pick, (40.25, 100.5))
    np.testing.assert_allclose(sample.place, (90.0, 200.0))
    assert sample.pick_theta == 2.0
    assert sample.rotation == -3.5


def test_other_points_of_the_object_move_rigidly_with_it():
    # The object turns by 90 degrees: a point below the pick goes to the right of the place.
    sample = LabelledImage(
        SAMPLE.image, np.array([10.0, 20]), 0.0, np.array([40.0, 50]), math.pi / 2
    )
    np.testing.assert_allclose(sample.place_of(sample.pick), sample.place)
    np.testing.assert_allclose(sample.place_of(np.array([13.0, 20])), (40, 53))


@pytest.mark.parametrize("centre", [(30, 40), (0, 0), (60, 90), (-3, 45), (200, 20)])
def test_crops_are_around_their_pixel_and_zero_outside(centre: tuple[int, int]):
    image = np.random.default_rng(0).random((4, ROWS, COLS)).astype(np.float32)
    taken = crop(image, centre, 9)
    assert taken.shape == (4, 9, 9)
    for row in range(9):
        for col in range(9):
            i, j = centre[0] + row - 4, centre[1] + col - 4
            inside = 0 <= i < ROWS and 0 <= j < COLS
            np.testing.assert_array_equal(taken[:, row, col], image[:, i, j] if inside else 0)


def test_labels_move_with_the_image():
    random = np.random.default_rng(1)
    for _ in range(10):
        angle, shift = random.uniform(-np.pi, np.pi), random.uniform(-3, 3, size=2)
        moved = move(marked((27.0, 40.0), (36.5, 52.25)), angle, shift)
        np.testing.assert_allclose(hill(moved, moved.pick), moved.pick, atol=0.3)
        np.testing.assert_allclose(hill(moved, moved.place), moved.place, atol=0.3)
        assert moved.pick_theta == pytest.approx(0.3 + angle)
        assert moved.rotation == 1.1
        # The vector from pick to place only rotates.
        expected = rotation_matrix(angle) @ (np.array([36.5, 52.25]) - (27.0, 40.0))
        np.testing.assert_allclose(moved.place - moved.pick, expected)


def test_other_objects_move_too():
    sample = LabelledImage(
        SAMPLE.image,
        SAMPLE.pick,
        0.3,
        SAMPLE.place,
        1.1,
        other_picks=np.array([MIDDLE, MIDDLE + (10, 0)]),
        other_thetas=np.array([0.1, 0.2]),
    )
    moved = move(sample, math.pi / 2, np.array([1.0, 2.0]))
    np.testing.assert_allclose(moved.other_picks - MIDDLE, [(1, 2), (1, 12)], atol=1e-9)
    np.testing.assert_allclose(moved.other_thetas, np.array([0.1, 0.2]) + math.pi / 2)


def test_a_rotation_by_180_degrees_is_exact():
    moved = move(SAMPLE, math.pi, np.zeros(2))
    np.testing.assert_array_equal(moved.image, SAMPLE.image[:, ::-1, ::-1])
    np.testing.assert_allclose(moved.pick, 2 * MIDDLE - SAMPLE.pick)


def test_heights_are_not_interpolated():
    moved = move(SAMPLE, 0.7, np.array([0.4, -0.3]))
    assert set(np.unique(moved.image[3])) <= {0, *np.unique(SAMPLE.image[3])}
    assert moved.image.dtype == np.float32
    # Pixels from outside the image are unseen.
    np.testing.assert_array_equal(moved.image[:, 0, 0], 0)


def test_augmentation_keeps_both_labels_inside():
    sample = marked((10.0, 15.0), (50.0, 60.0))
    angles, shifts = [], []
    for seed in range(100):
        moved = augment(sample, np.random.default_rng(seed))
        for label in (moved.pick, moved.place):
            assert (label >= 0).all()
            assert (label <= (ROWS - 1, COLS - 1)).all()
        angles.append(math.remainder(moved.pick_theta - 0.3, math.tau))
        shifts.append(moved.pick - Motion(moved.image, angles[-1], np.zeros(2)).after(sample.pick))
    assert np.std(angles) > math.radians(20)
    assert (np.std(shifts, axis=0) > (ROWS / 12, COLS / 12)).all()
    assert len(set(angles)) == 100


def test_augmentation_is_determined_by_the_seed():
    one, same, other = (augment(SAMPLE, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.image, same.image)
    np.testing.assert_array_equal(one.pick, same.pick)
    assert not np.array_equal(one.pick, other.pick)


def test_a_sample_that_cannot_stay_inside_is_not_moved():
    sample = LabelledImage(SAMPLE.image, np.array([-30.0, 0]), 0.3, np.array([90.0, 90]), 1.1)
    assert augment(sample, np.random.default_rng(0)) is sample


def barred(theta: float) -> LabelledImage:
    """A long bar, 6 pixels wide, picked at its centre."""
    row, col = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
    offsets = np.stack([row, col], axis=-1) - MIDDLE
    across = offsets @ rotation_matrix(theta)[:, 1]
    height = np.where(np.abs(across) < 3, 0.02, 0)
    image = np.stack([height] * 4).astype(np.float32)
    return LabelledImage(image, MIDDLE, theta, np.array([10.0, 20]), 0.0)


def middle_line(image: np.ndarray, theta: float, u: float) -> float:
    """The sideways offset, in pixels, of a bar's centre line from a reference line.

    The reference line passes through the image's centre in direction `theta`. The offset is
    measured `u` pixels along it.
    """
    across = np.linspace(-12, 12, 97)
    points = (
        np.array(image.shape[1:]) // 2
        + np.array([u, 0]) @ rotation_matrix(theta).T
        + across[:, None] * rotation_matrix(theta)[:, 1]
    )
    row, col = np.rint(points).astype(int).T
    return float(across[image[3, row, col] > 0].mean())


@pytest.mark.parametrize("theta", [0.0, 0.7, 2.0])
@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("index", [0, 1])
def test_curvature_keeps_position_and_direction_at_the_pick(theta: float, moved: bool, index: int):
    sample = barred(theta)
    if index:
        # The bar is not the picked object, but one of the others.
        sample = dataclasses.replace(
            sample,
            pick=np.array([10.0, 80.0]),
            pick_theta=theta + 1.0,
            other_picks=MIDDLE[None],
            other_thetas=np.array([theta]),
        )
    if moved:
        sample = move(sample, 0.4, np.array([2.0, -3]))
        theta += 0.4
    curvatures = np.array([[-0.5, 0.5]] * index + [[0.3, -0.1]])
    sample = dataclasses.replace(sample, curvatures=curvatures)
    row, col = np.rint(sample.other_picks[0] if index else sample.pick).astype(int)
    curved = sample.curved_crop(index, (int(row), int(col)), 41)
    start = middle_line(curved, theta, 0)
    for u in (-16, -8, -3, 3, 8, 16):
        v = u / 20
        # The crop samples displaced pixels, so the object seems displaced the other way.
        expected = -20 * (0.3 * v**2 - 0.1 * v**3)
        assert middle_line(curved, theta, u) - start == pytest.approx(expected, abs=1.2)


def test_a_crop_with_zero_curvature_is_a_plain_crop():
    sample = move(SAMPLE, 0.6, np.array([3.0, -2]))
    pixel = (22, 31)
    expected = crop(sample.image, pixel, 41)
    straight = dataclasses.replace(sample, curvatures=np.zeros((1, 2)))
    np.testing.assert_array_equal(straight.curved_crop(0, pixel, 41), expected)


def test_every_object_has_its_own_curvature():
    others = np.array([[20.0, 60], [40, 30]])
    sample = dataclasses.replace(SAMPLE, other_picks=others, other_thetas=np.zeros(2))
    curved = augment(sample, np.random.default_rng(0), curvature=True)
    assert len(np.unique(curved.curvatures)) == 6
    assert not len(augment(sample, np.random.default_rng(0)).curvatures)


@pytest.mark.parametrize("theta", [0.0, 0.7, 2.0])
def test_reflection_mirrors_the_image_and_its_labels(theta: float):
    sample = dataclasses.replace(
        SAMPLE, other_picks=np.array([[20.0, 60]]), other_thetas=np.array([0.2])
    )
    mirrored = reflect(sample)
    for name in ("pick", "place"):
        at = getattr(mirrored, name)
        np.testing.assert_allclose(hill(mirrored, at), at, atol=0.02)
    assert (mirrored.pick_theta, mirrored.rotation) == (-0.3, -1.1)
    np.testing.assert_array_equal(mirrored.other_picks, [[20.0, COLS - 1 - 60]])
    # A bar's grasp angle is mirrored with the bar.
    bar = reflect(barred(theta))
    middles = [middle_line(bar.image, bar.pick_theta, u) for u in (-12, 0, 12)]
    np.testing.assert_allclose(middles, 0.0, atol=0.5)
    # A mirrored scene's object rotates in the opposite direction.
    beside = sample.pick + (3.0, -2.0)
    across = np.array([0, COLS - 1]) + beside * (1, -1)
    expected = np.array([0, COLS - 1]) + sample.place_of(beside) * (1, -1)
    np.testing.assert_allclose(mirrored.place_of(across), expected)
    twice = reflect(mirrored)
    np.testing.assert_array_equal(twice.image, sample.image)
    np.testing.assert_array_equal(twice.place, sample.place)


def test_half_of_the_samples_are_reflected_if_allowed():
    random = np.random.default_rng(0)
    rotations = [augment(SAMPLE, random, reflection=True).rotation for _ in range(60)]
    assert set(rotations) == {SAMPLE.rotation, -SAMPLE.rotation}
    assert 20 < rotations.count(SAMPLE.rotation) < 40
    assert augment(SAMPLE, random).rotation == SAMPLE.rotation


def test_before_inverts_after():
    motion = Motion(SAMPLE.image, 0.7, np.array([3.0, -2]))
    points = np.array([[[1.0, 2], [30, 40]]])
    np.testing.assert_allclose(motion.before(motion.after(points)), points)
    assert np.abs(motion.after(points) - points).max() > 1
