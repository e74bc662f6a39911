"""Simulates the errors of a real RGB-D camera: noise, holes and calibration errors."""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import DepthRenderCamera
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I, ImageRgba8U

from systems.bounds import bounded
from systems.weak_calc import weak_calc

SHEEN_LABELS = 20000
"""The render label SHEEN_LABELS + p marks a shiny surface, p percent of which become holes."""

_RIG_STREAM, _CAMERA_STREAM, _DEPTH_STREAM = 14, 15, 16
"""Numbers of this module's random streams: a generator's seed begins with [seed, number]. Each
stream of the package has its own number. Zero is avoided, because NumPy treats [seed, 2, 0] like
[seed, 2]."""
_TIME_RESOLUTION = 1e-6
"""Images farther apart in time than this, in seconds, have independent noise."""
_HOLE_RADIUS = 3.0
"""Smoothing radius, in pixels, of the random field whose highest parts become holes."""
_EDGE = 0.015
"""Neighbouring depths that differ by more than this, in metres, belong to different sides of an
edge."""


@dc.dataclass
class SensorNoiseParameters:
    """Imperfections of the RGB-D cameras and their calibration. The defaults describe perfect
    cameras."""

    # Standard deviation of the depth's noise at 1 m, in m. It grows with the square of the depth,
    # as for a stereo camera.
    depth_std: float = bounded(0.0, 0.0, 0.1)

    # Correlation length of the depth noise: radius of the smoothing kernel, in pixels.
    correlation: float = bounded(1.5, 0.0, 20.0)

    # Quantization step of the depth at 1 m, in m. It grows with the square of the depth.
    depth_step: float = bounded(0.0, 0.0, 0.1)

    # Share of the pixels beside an edge that get a depth between those of the edge's two sides.
    flying_share: float = bounded(0.0, 0.0, 1.0)

    # Share of the pixels that are holes, which have no depth.
    hole_share: float = bounded(0.0, 0.0, 0.9)

    # Surfaces seen at more than this angle from their normal, in degrees, give no depth.
    steepest_deg: float = bounded(90.0, 1.0, 90.0)

    # Number of images per observation; each pixel gets their median depth. The time to take them,
    # 33 ms each, is not simulated.
    frames: int = bounded(1, 1, 100)

    # Standard deviation of the relative gain of each colour channel.
    white_balance_std: float = bounded(0.0, 0.0, 1.0)

    # Size of the error of each camera's calibrated pose, in m and in degrees; its direction is
    # random.
    camera_position_error: float = bounded(0.0, 0.0, 0.1)
    camera_angle_error_deg: float = bounded(0.0, 0.0, 20.0)

    # Size of a pose error common to all cameras, as if their mount had moved: a shift in m, and a
    # rotation about the workspace's middle in degrees.
    rig_position_error: float = bounded(0.0, 0.0, 0.1)
    rig_angle_error_deg: float = bounded(0.0, 0.0, 20.0)

    # Error of the calibrated height of all cameras, in m. If it is positive, the table and
    # everything on it seem to lie too high by as much.
    rig_height_error: float = bounded(0.0, -0.1, 0.1)

    @property
    def is_none(self) -> bool:
        """Whether all imperfections are off."""
        return not any(
            (
                self.depth_std,
                self.depth_step,
                self.flying_share,
                self.hole_share,
                self.steepest_deg < 90,
                self.white_balance_std,
                self.camera_position_error,
                self.camera_angle_error_deg,
                self.rig_position_error,
                self.rig_angle_error_deg,
                self.rig_height_error,
            )
        )


class SensorNoise(LeafSystem):
    """Adds the errors of a real camera to the outputs of an RgbdSensor.

    .. pydrake_system::

        name: SensorNoise
        input_ports:
        - color_image (optional)
        - depth_image_32f
        - label_image (optional)
        - body_pose_in_world
        output_ports:
        - color_image
        - depth_image_32f
        - body_pose_in_world

    The output ports have the names and types of the sensor's, so that this system can replace it in
    a diagram. The law:

    - Depth z gets noise of standard deviation `depth_std (z / 1 m)^2`, smoothed over `correlation`
      pixels at constant variance, and is rounded to multiples of `depth_step (z / 1 m)^2`.
    - Beside an edge (a step of more than 15 mm between neighbours), a share `flying_share` of the
      pixels gets a depth between those of the two sides.
    - Holes get depth 0, which Drake's cameras return for objects that are too close. Blobs of holes
      cover the share `hole_share` of the image. If `label_image` is connected, they cover p percent
      of each surface with the label SHEEN_LABELS + p. Pixels that see a surface at more than
      `steepest_deg` from its normal, such as those at outlines, are holes as well.
    - The output depth is the median of `frames` such images with independent noise.
    - Each colour channel is multiplied by a normally distributed gain of mean one.
    - `body_pose_in_world` is the *calibrated* pose, `X_Rig X_WB X_Camera`. Its errors have the
      given sizes, in directions drawn once for each seed; `rig_height_error` is added to z as it
      is. The images show the view from the true pose.

    All draws depend on the seed, the camera's number and the time (to the microsecond) only.
    Stateless: evaluating twice gives the same images.
    """

    def __init__(
        self,
        *,
        parameters: SensorNoiseParameters,
        camera: DepthRenderCamera,
        seed: int,
        number: int,
        workspace_middle: tuple[float, float] = (0.5, 0.0),
        use_labels: bool = False,
    ) -> None:
        """
        Args:
            parameters: the parameters of the noise.
            camera: the sensor's depth camera.
            seed: the seed of all draws.
            number: number of the camera. With `seed`, it determines the camera's own errors, but
                not the pose error common to all cameras.
            workspace_middle: (x, y) in the world, in metres, about which the common pose error
                rotates the cameras.
            use_labels: whether to declare the input port `label_image`.
        """
        super().__init__()
        self._parameters = parameters
        self._seed, self._number = seed, number
        info = camera.core().intrinsics()
        self._camera = info
        self._shape = (info.height(), info.width())
        middle = RigidTransform([*workspace_middle, 0.0])
        rig = _pose_error(
            np.random.default_rng([seed, _RIG_STREAM]),
            parameters.rig_position_error,
            parameters.rig_angle_error_deg,
        )
        rise = RigidTransform([0.0, 0.0, parameters.rig_height_error])
        self._X_rig = rise @ middle @ rig @ middle.inverse()
        own = np.random.default_rng([seed, _CAMERA_STREAM, number])
        self._X_camera = _pose_error(
            own, parameters.camera_position_error, parameters.camera_angle_error_deg
        )
        gains = 1 + parameters.white_balance_std * own.standard_normal(3)
        self._gains = np.maximum(gains, 0).astype(np.float32)

        self._color = self.DeclareAbstractInputPort("color_image", Value(ImageRgba8U()))
        self._depth = self.DeclareAbstractInputPort("depth_image_32f", Value(ImageDepth32F()))
        self._label = None
        if use_labels:
            self._label = self.DeclareAbstractInputPort("label_image", Value(ImageLabel16I()))
        self._pose = self.DeclareAbstractInputPort("body_pose_in_world", Value(RigidTransform()))
        height, width = self._shape
        self.DeclareAbstractOutputPort(
            "color_image",
            lambda: Value(ImageRgba8U(width, height)),
            weak_calc(self._calc_color),
            {self._color.ticket()},
        )
        depends = {self._depth.ticket(), self.time_ticket()}
        if self._label is not None:
            depends.add(self._label.ticket())
        self.DeclareAbstractOutputPort(
            "depth_image_32f",
            lambda: Value(ImageDepth32F(width, height)),
            weak_calc(self._calc_depth),
            depends,
        )
        self.DeclareAbstractOutputPort(
            "body_pose_in_world",
            lambda: Value(RigidTransform()),
            weak_calc(self._calc_pose),
            {self._pose.ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        X_WB: RigidTransform = self._pose.Eval(context)
        output.set_value(self._X_rig @ X_WB @ self._X_camera)

    def _calc_color(self, context: Context, output: AbstractValue) -> None:
        data = np.asarray(self._color.Eval(context).data)
        image = ImageRgba8U(data.shape[1], data.shape[0])
        seen = image.mutable_data
        seen[:] = data
        if self._parameters.white_balance_std:
            gained = data[:, :, :3] * self._gains
            seen[:, :, :3] = np.minimum(np.rint(gained), 255).astype(np.uint8)
        output.set_value(image)

    def _calc_depth(self, context: Context, output: AbstractValue) -> None:
        data = np.asarray(self._depth.Eval(context).data)
        image = ImageDepth32F(data.shape[1], data.shape[0])
        frame = round(context.get_time() / _TIME_RESOLUTION)
        random = np.random.default_rng([self._seed, _DEPTH_STREAM, self._number, frame])
        sheen = None
        if self._label is not None:
            labels = np.asarray(self._label.Eval(context).data)[:, :, 0].astype(np.int32)
            sheen = np.where(
                (labels > SHEEN_LABELS) & (labels <= SHEEN_LABELS + 100),
                (labels - SHEEN_LABELS) / 100,
                0.0,
            ).astype(np.float32)
        frames = [
            noisy_depth(data[:, :, 0], self._parameters, self._camera, random, sheen)
            for _ in range(self._parameters.frames)
        ]
        image.mutable_data[:, :, 0] = frames[0] if len(frames) == 1 else median_depth(frames)
        output.set_value(image)


def noisy_depth(
    depth: NDArray[np.float32],
    parameters: SensorNoiseParameters,
    camera: CameraInfo,
    random: np.random.Generator,
    sheen: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Adds noise and holes to a depth image; see `SensorNoise` for the law.

    Args:
        depth: (height, width), in metres; 0 and infinity are invalid.
        parameters: the parameters of the noise.
        camera: the camera's intrinsics.
        random: the random generator of all draws.
        sheen: (height, width), for each pixel the share of its surface that becomes holes; None if
            no surface is shiny.
    """
    seen = np.isfinite(depth) & (depth > 0)
    z = np.where(seen, depth, 1.0).astype(np.float32)
    # Import SciPy lazily.
    from scipy import ndimage

    hole = np.zeros(depth.shape, bool)
    if parameters.steepest_deg < 90:
        hole |= _incidence(z, seen, camera) < math.cos(math.radians(parameters.steepest_deg))
    noisy = z
    if parameters.flying_share:
        # Ignore neighbours without a depth. A pixel that has only such neighbours keeps its depth.
        low, high = (
            np.where(seen, extreme(np.where(seen, z, none), 3), z)
            for extreme, none in (
                (ndimage.minimum_filter, np.float32(np.inf)),
                (ndimage.maximum_filter, np.float32(-np.inf)),
            )
        )
        flying = (high - low > _EDGE) & (random.random(z.shape) < parameters.flying_share)
        mixed = low + (high - low) * random.random(z.shape, dtype=np.float32)
        noisy = np.where(flying, mixed, noisy)
        hole &= ~flying
    square = z * z
    if parameters.depth_std:
        noisy = noisy + parameters.depth_std * square * _unit_field(
            random, z.shape, parameters.correlation
        )
    if parameters.depth_step:
        step = parameters.depth_step * square
        noisy = np.rint(noisy / step) * step
    if parameters.hole_share or sheen is not None:
        field = _unit_field(random, z.shape, _HOLE_RADIUS)
        share = np.full(z.shape, parameters.hole_share, np.float32)
        if sheen is not None:
            share = np.maximum(share, sheen)
        hole |= field > _upper_quantile(share)
    return np.where(hole | ~seen, np.where(seen, 0.0, depth), noisy).astype(np.float32)


def _incidence(
    z: NDArray[np.float32], seen: NDArray[np.bool_], camera: CameraInfo
) -> NDArray[np.float32]:
    """(height, width) cosine of the angle between each pixel's ray and the surface's normal; NaN
    beside pixels without depth.

    Args:
        z: (height, width), depths in metres.
        seen: (height, width) mask of the pixels with a valid depth.
        camera: the camera's intrinsics.
    """
    # Pixel centres are at half-integers.
    columns, rows = np.arange(z.shape[1]) + 0.5, np.arange(z.shape[0]) + 0.5
    x = ((columns - camera.center_x()) / camera.focal_x()).astype(np.float32)
    y = ((rows - camera.center_y()) / camera.focal_y()).astype(np.float32)[:, None]
    by_row, by_col = np.gradient(np.where(seen, z, np.float32(np.nan)))
    along_x, along_y = by_col * np.float32(camera.focal_x()), by_row * np.float32(camera.focal_y())
    # The surface z (x, y, 1) has the normal (-dz/dx, -dz/dy, z + x dz/dx + y dz/dy). The dot
    # product of this normal with the ray (x, y, 1) is z.
    normal = np.sqrt(along_x**2 + along_y**2 + (z + x * along_x + y * along_y) ** 2)
    return z / (normal * np.sqrt(x**2 + y**2 + 1))


def median_depth(frames: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """The median of each pixel's valid depths over some images.

    Args:
        frames: the images, (height, width) each, in metres; 0 and infinity are invalid.

    Returns:
        (height, width) depths in metres. A pixel that is never valid keeps its value in the first
        image.
    """
    stack = np.stack(frames)
    stack[~(np.isfinite(stack) & (stack > 0))] = np.nan
    stack.sort(axis=0)  # NaN is sorted to the end.
    count = np.isfinite(stack).sum(axis=0, keepdims=True)
    middle = [np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(stack) - 1)]
    low, high = (np.take_along_axis(stack, index, axis=0)[0] for index in middle)
    return np.where(count[0] > 0, (low + high) / 2, frames[0]).astype(np.float32)


def _unit_field(
    random: np.random.Generator, shape: tuple[int, ...], radius: float
) -> NDArray[np.float32]:
    """A field of normally distributed values, smoothed by a Gaussian of a radius in pixels and
    scaled to unit variance."""
    values = random.standard_normal(shape, dtype=np.float32)
    if radius <= 0:
        return values
    # Import SciPy lazily.
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(values, radius, mode="wrap", truncate=3.0)
    return smooth / max(float(smooth.std()), 1e-12)


def _upper_quantile(share: NDArray[np.float32]) -> NDArray[np.float32]:
    """The value above which a given share of the standard normal distribution lies."""
    # Import SciPy lazily.
    from scipy.special import ndtri

    return ndtri(1 - np.clip(share, 1e-9, 1 - 1e-9)).astype(np.float32)


def _pose_error(random: np.random.Generator, distance: float, angle_deg: float) -> RigidTransform:
    """A translation and a rotation of the given sizes, in random directions."""
    shift, axis = random.standard_normal(3), random.standard_normal(3)
    axis /= np.linalg.norm(axis)
    half = math.radians(angle_deg) / 2
    turn = Quaternion(np.append(math.cos(half), math.sin(half) * axis))
    return RigidTransform(RotationMatrix(turn), distance * shift / np.linalg.norm(shift))
