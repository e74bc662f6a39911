import math
from collections.abc import Callable

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import ClippingRange, DepthRange, DepthRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I, ImageRgba8U

from systems.sensor_noise import (
    SHEEN_LABELS,
    SensorNoise,
    SensorNoiseParameters,
    median_depth,
    noisy_depth,
)

WIDTH, HEIGHT, FOCAL = 160, 120, 112.0
INFO = CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
POSE = RigidTransform(RollPitchYaw(0.8, 3.0, -1.5), [1.0, 0.1, 0.75])


def camera() -> DepthRenderCamera:
    core = RenderCameraCore("none", INFO, ClippingRange(0.01, 10.0), RigidTransform())
    return DepthRenderCamera(core, DepthRange(0.01, 10.0))


def system(*, seed: int = 3, number: int = 0, use_labels: bool = False, **noise: float):
    parameters = SensorNoiseParameters(**noise)
    return SensorNoise(
        parameters=parameters, camera=camera(), seed=seed, number=number, use_labels=use_labels
    )


def context_of(noise: SensorNoise, depth: np.ndarray, color: int = 100):
    context = noise.CreateDefaultContext()
    image = ImageDepth32F(WIDTH, HEIGHT)
    image.mutable_data[:, :, 0] = depth
    noise.GetInputPort("depth_image_32f").FixValue(context, Value(image))
    colours = ImageRgba8U(WIDTH, HEIGHT)
    colours.mutable_data[:] = color
    noise.GetInputPort("color_image").FixValue(context, Value(colours))
    noise.GetInputPort("body_pose_in_world").FixValue(context, Value(POSE))
    return context


def depth_of(noise: SensorNoise, context) -> np.ndarray:
    return np.array(noise.GetOutputPort("depth_image_32f").Eval(context).data[:, :, 0])


def test_output_ports_are_those_of_a_sensor():
    noise = system(use_labels=True)
    inputs = [noise.get_input_port(i).get_name() for i in range(noise.num_input_ports())]
    outputs = [noise.get_output_port(i).get_name() for i in range(noise.num_output_ports())]
    assert inputs == ["color_image", "depth_image_32f", "label_image", "body_pose_in_world"]
    assert outputs == ["color_image", "depth_image_32f", "body_pose_in_world"]
    assert system().num_input_ports() == 3


def test_without_noise_the_outputs_equal_the_inputs():
    noise = system()
    depth = np.linspace(0.5, 1.5, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    depth[0, 0], depth[0, 1] = 0, np.inf
    context = context_of(noise, depth)
    np.testing.assert_array_equal(depth_of(noise, context), depth)
    assert noise.GetOutputPort("body_pose_in_world").Eval(context).IsExactlyEqualTo(POSE)
    assert (noise.GetOutputPort("color_image").Eval(context).data == 100).all()


def test_noise_grows_with_the_square_of_depth():
    noise = system(depth_std=0.002)
    for distance in (0.5, 1.0, 2.0):
        seen = depth_of(noise, context_of(noise, np.full((HEIGHT, WIDTH), distance)))
        assert seen.std() == pytest.approx(0.002 * distance**2, rel=0.02)
        # The errors of neighbouring pixels are correlated.
        left, right = seen[:, :-1].ravel(), seen[:, 1:].ravel()
        assert np.corrcoef(left, right)[0, 1] > 0.7


def test_noise_depends_on_time_seed_and_camera_only():
    flat = np.full((HEIGHT, WIDTH), 0.9)

    def seen(time: float = 0.5, **arguments: int) -> np.ndarray:
        noise = system(depth_std=0.001, hole_share=0.05, **arguments)
        context = context_of(noise, flat)
        context.SetTime(time)
        return depth_of(noise, context)

    np.testing.assert_array_equal(seen(), seen())
    for other in (seen(time=0.625), seen(seed=4), seen(number=1)):
        assert (other != seen()).mean() > 0.9


def test_hole_shares_of_the_image_and_of_shiny_surfaces():
    flat = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    random = np.random.default_rng(0)
    shares = [
        (noisy_depth(flat, SensorNoiseParameters(hole_share=0.05), INFO, random) == 0)
        for _ in range(20)
    ]
    assert np.mean(shares) == pytest.approx(0.05, rel=0.15)
    noise = system(use_labels=True)
    context = context_of(noise, flat)
    labels = ImageLabel16I(WIDTH, HEIGHT)
    labels.mutable_data[:] = 7
    labels.mutable_data[:, WIDTH // 2 :] = SHEEN_LABELS + 60
    noise.GetInputPort("label_image").FixValue(context, Value(labels))
    holes = depth_of(noise, context) == 0
    assert not holes[:, : WIDTH // 2].any()
    assert 0.45 < holes[:, WIDTH // 2 :].mean() < 0.75
    # If the labels change, the holes change, too.
    labels.mutable_data[:] = 7
    noise.GetInputPort("label_image").FixValue(context, Value(labels))
    assert (depth_of(noise, context) != 0).all()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.7, 0.1, 0.7), (-0.3, 0.8, 0.5)])
def test_pixels_at_grazing_angles_are_holes(normal: tuple[float, float, float]):
    """On a plane the angles between the rays and the normal are known."""
    x, y = np.meshgrid(
        (np.arange(WIDTH) + 0.5 - INFO.center_x()) / FOCAL,
        (np.arange(HEIGHT) + 0.5 - INFO.center_y()) / FOCAL,
    )
    rays = np.stack([x, y, np.ones(x.shape)], axis=-1)
    facing = rays @ (np.array(normal) / np.linalg.norm(normal))
    angle = np.degrees(np.arccos(facing / np.linalg.norm(rays, axis=-1)))
    plane = np.where(facing > 0.05, 0.7 / np.maximum(facing, 0.05), np.inf).astype(np.float32)
    limit = float(np.median(angle))
    noise = SensorNoiseParameters(steepest_deg=limit)
    seen = noisy_depth(plane, noise, INFO, np.random.default_rng(0))
    clear = np.isfinite(plane) & (np.abs(angle - limit) > 1.0)
    assert 0.2 < (angle[clear] > limit).mean() < 0.8
    assert ((seen == 0) == (angle > limit))[clear].mean() > 0.99


def test_holes_of_a_frontal_wall_are_symmetric():
    depth = np.full((HEIGHT, WIDTH), 0.7, np.float32)
    # Only rays near the image's corners make a larger angle than this with the wall's normal.
    noise = SensorNoiseParameters(steepest_deg=36.0)
    holes = noisy_depth(depth, noise, INFO, np.random.default_rng(0)) == 0
    assert 0 < holes.mean() < 0.5
    np.testing.assert_array_equal(holes, holes[::-1])
    np.testing.assert_array_equal(holes, holes[:, ::-1])


def test_pixels_without_depth_stay_unchanged():
    depth = np.full((HEIGHT, WIDTH), 0.7, np.float32)
    depth[:, WIDTH // 3 :] = np.inf
    depth[:, 2 * WIDTH // 3 :] = 0.0
    noise = SensorNoiseParameters(flying_share=1.0, steepest_deg=60.0)
    seen = noisy_depth(depth, noise, INFO, np.random.default_rng(0))
    np.testing.assert_array_equal(seen, depth)


def test_depth_steps_grow_with_the_square_of_depth():
    for distance in (0.5, 1.5):
        depth = np.full((HEIGHT, WIDTH), distance, np.float32)
        noise = SensorNoiseParameters(depth_std=0.002, depth_step=0.004)
        seen = noisy_depth(depth, noise, INFO, np.random.default_rng(0))
        steps = seen / (0.004 * distance**2)
        np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
        assert 2 < len(np.unique(np.rint(steps))) < 8


def test_outputs_follow_their_inputs():
    noise = system(depth_std=0.001, white_balance_std=0.1, camera_position_error=0.001)
    context = context_of(noise, np.full((HEIGHT, WIDTH), 0.9))
    ports = ("color_image", "depth_image_32f", "body_pose_in_world")

    def values() -> list[np.ndarray]:
        color, depth, pose = (noise.GetOutputPort(name).Eval(context) for name in ports)
        return [np.array(color.data), np.array(depth.data), pose.GetAsMatrix34()]

    before = values()
    image, colours = ImageDepth32F(WIDTH, HEIGHT), ImageRgba8U(WIDTH, HEIGHT)
    image.mutable_data[:], colours.mutable_data[:] = 1.4, 40
    noise.GetInputPort("depth_image_32f").FixValue(context, Value(image))
    noise.GetInputPort("color_image").FixValue(context, Value(colours))
    moved = RigidTransform(POSE.rotation(), POSE.translation() + [0, 0, 0.5])
    noise.GetInputPort("body_pose_in_world").FixValue(context, Value(moved))
    for old, new in zip(before, values(), strict=True):
        assert (old != new).any()


def test_flying_pixels_occur_only_beside_edges():
    step = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    step[:, WIDTH // 2 :] = 0.9
    seen = noisy_depth(
        step, SensorNoiseParameters(flying_share=0.5), INFO, np.random.default_rng(1)
    )
    changed = seen != step
    assert changed[:, WIDTH // 2 - 1 : WIDTH // 2 + 1].mean() == pytest.approx(0.5, abs=0.12)
    assert changed.sum() == changed[:, WIDTH // 2 - 1 : WIDTH // 2 + 1].sum()
    assert (seen >= 0.9 - 1e-6).all()
    assert (seen <= 1.0 + 1e-6).all()


def test_the_median_of_frames_is_less_noisy_and_has_fewer_holes():
    depth = np.full((HEIGHT, WIDTH), 1.2, np.float32)
    one, five = (
        depth_of(noise, context_of(noise, depth))
        for noise in (
            system(depth_std=0.002, hole_share=0.1, frames=frames, correlation=1.0)
            for frames in (1, 5)
        )
    )
    errors = [float(np.std(image[image > 0] - 1.2)) for image in (one, five)]
    # The median of five normal values has 0.536 times the standard deviation of a single value.
    assert errors[0] == pytest.approx(0.002 * 1.2**2, rel=0.1)
    assert 0.5 < errors[1] / errors[0] < 0.62
    assert (one == 0).mean() > 0.05
    assert not (five == 0).any()


def test_the_median_ignores_invalid_depths():
    frames = np.array([[3, 0, np.inf, 1], [1, 2, np.inf, 0], [2, 4, np.inf, 0]], np.float32)
    found = median_depth([frame[None] for frame in frames])
    np.testing.assert_array_equal(found, np.array([[2, 3, np.inf, 1]], np.float32))


def believed_pose(*, seed: int, number: int = 0, **errors: float) -> RigidTransform:
    noise = system(seed=seed, number=number, **errors)
    context = context_of(noise, np.ones((HEIGHT, WIDTH)))
    return noise.GetOutputPort("body_pose_in_world").Eval(context)


def rig_error(seed: int) -> RigidTransform:
    """The pose error common to all cameras, in a frame at the middle of the workspace."""
    middle = RigidTransform([0.5, 0.0, 0.0])
    errors = {"rig_position_error": 0.01, "rig_angle_error_deg": 2.0}
    return middle.inverse() @ believed_pose(seed=seed, **errors) @ POSE.inverse() @ middle


def camera_error(seed: int, number: int = 0) -> RigidTransform:
    errors = {"camera_position_error": 0.01, "camera_angle_error_deg": 2.0}
    return POSE.inverse() @ believed_pose(seed=seed, number=number, **errors)


def test_a_height_error_lifts_every_camera():
    for number in (0, 1):
        lifted = believed_pose(seed=7, number=number, rig_height_error=-0.005)
        assert lifted.IsNearlyEqualTo(RigidTransform([0, 0, -0.005]) @ POSE, 1e-12)
    assert not SensorNoiseParameters(rig_height_error=-0.005).is_none


@pytest.mark.parametrize("error", [rig_error, camera_error])
def test_pose_errors_depend_on_the_seed(error: Callable[[int], RigidTransform]):
    first, other = error(7), error(8)
    assert error(7).IsExactlyEqualTo(first)
    assert np.linalg.norm(first.translation() - other.translation()) > 1e-3
    assert (first.rotation().inverse() @ other.rotation()).ToAngleAxis().angle() > 1e-3


@pytest.mark.parametrize(
    ("error", "own"),
    [(rig_error, [14]), (camera_error, [15, 0]), (lambda seed: camera_error(seed, 2), [15, 2])],
)
def test_pose_errors_have_their_own_random_streams(
    error: Callable[[int], RigidTransform], own: list[int]
):
    """No other stream [seed, ...] may give the same numbers.

    Scenes use [seed] and [seed, k] with small k. Other random values use larger k. NumPy pads seeds
    with zeros, so [seed, 15, 0] equals [seed, 15].
    """
    shift = error(7).translation()
    shift = shift / np.linalg.norm(shift)
    others = [[stream, number] for stream in range(20) for number in range(3)]
    for stream in others:
        direction = np.random.default_rng([7, *stream]).standard_normal(3)
        cosine = shift @ direction / np.linalg.norm(direction)
        is_own = stream == [*own, 0][:2]
        assert (cosine > 0.999999) == is_own, f"stream {stream}"


def test_no_two_draws_share_a_stream(monkeypatch: pytest.MonkeyPatch):
    streams: list[list[int]] = []

    def recorded(stream: list[int]) -> np.random.Generator:
        streams.append([*stream, 0, 0, 0, 0][:5])
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(stream)))

    monkeypatch.setattr("numpy.random.default_rng", recorded)
    noise = system(seed=7, depth_std=0.001)
    depth_of(noise, context_of(noise, np.ones((HEIGHT, WIDTH))))
    # The rig, the camera and the image have one stream each.
    assert len(streams) == 3
    assert len(set(map(tuple, streams))) == 3


def test_calibration_errors_have_the_given_sizes():
    def believed(number: int, **errors: float) -> RigidTransform:
        noise = system(number=number, **errors)
        context = context_of(noise, np.ones((HEIGHT, WIDTH)))
        return noise.GetOutputPort("body_pose_in_world").Eval(context)

    rig = [
        believed(number, rig_position_error=0.003, rig_angle_error_deg=0.3) @ POSE.inverse()
        for number in (0, 1)
    ]
    # The error of the rig is the same for all cameras: it moves the workspace's middle, and rotates
    # the rig about this point.
    assert rig[0].IsNearlyEqualTo(rig[1], 1e-12)
    assert np.linalg.norm(rig[0] @ np.array([0.5, 0, 0]) - (0.5, 0, 0)) == pytest.approx(0.003)
    angle = rig[0].rotation().ToAngleAxis().angle()
    assert math.degrees(angle) == pytest.approx(0.3, rel=1e-4)
    own = [
        POSE.inverse() @ believed(n, camera_position_error=0.001, camera_angle_error_deg=0.1)
        for n in (0, 1)
    ]
    assert not own[0].IsNearlyEqualTo(own[1], 1e-5)
    for error in own:
        assert np.linalg.norm(error.translation()) == pytest.approx(0.001)


def test_white_balance_scales_the_colour_channels():
    noise = system(white_balance_std=0.2)
    seen = noise.GetOutputPort("color_image").Eval(context_of(noise, np.ones((HEIGHT, WIDTH)))).data
    channels = seen.reshape(-1, 4)
    assert (channels == channels[0]).all()
    assert len(set(channels[0, :3].tolist())) == 3
    assert channels[0, 3] == 100
