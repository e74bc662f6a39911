"""From the cameras' images to the orthographic heightmap that the policies look at."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import DepthRenderCamera
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from systems.signals import Observation, PixelGrid

SAME_SURFACE = 0.01
"""Heights that differ by less than this, in metres, may belong to one surface."""


class HeightmapProjector(LeafSystem):
    """Projects the images of RGB-D cameras straight down onto the pixel grid over the workspace.

    .. pydrake_system::

        name: HeightmapProjector
        input_ports:
        - color_image_<camera>
        - depth_image_<camera>
        - body_pose_in_world_<camera>
        output_ports:
        - observation

    There are three input ports for each camera. They take the outputs `color_image`,
    `depth_image_32f` and `body_pose_in_world` (X_WB) of an RgbdSensor. The output port holds an
    Observation, computed when it is asked for and kept until an input changes; the passing of time
    alone does not make it stale. Its image is read-only, as every reader shares it.

    The law, for a camera D with intrinsics (fx, fy, cx, cy) and fixed pose X_BD in the sensor body:

    - Image pixel (u, v) covers [u, u+1) x [v, v+1), so its ray passes through (u + 1/2, v + 1/2):
      `p_WP = X_WB X_BD (depth * ((u + 1/2 - cx)/fx, (v + 1/2 - cy)/fy, 1))`. This is how Drake's
      VTK engine renders, to a hundredth of a pixel. A depth outside the camera's DepthRange (0 and
      infinity, Drake's too close and too far, among them) is no point, nor is NaN.
    - Points off the grid or above `z_max` are dropped; one below `z_min` reads as height 0. Of a
      camera's points in a grid pixel the highest wins, and brings its colour.
    - Height is the largest over the cameras. Colour is the mean over the cameras that see this top
      surface: one whose own highest point lies more than SAME_SURFACE (1 cm) below the fused height
      sees something that the top hides from above, a side or the ground before it, and must not
      tint it.
    - A camera's samples can be farther apart than grid pixels and step over one. A pixel
      that no camera saw, but whose two neighbours along x or along y were both seen, with heights
      within SAME_SURFACE of each other, is such a gap and gets the mean of the two, or of the
      higher pair. Nothing wider than one pixel is bridged: a shadow stays zero in all four
      channels, and is not `valid`.

    The colour camera must be registered with the depth camera: same intrinsics, same pose.
    """

    def __init__(
        self, *, cameras: Mapping[str, DepthRenderCamera], grid: PixelGrid | None = None
    ) -> None:
        """Declares the ports.

        Args:
            cameras: the depth camera of each sensor by name, as `RgbdSensor` takes it.
            grid: the pixels of the heightmap.

        Raises:
            ValueError: if there is no camera.
        """
        super().__init__()
        if not cameras:
            raise ValueError("HeightmapProjector needs at least one camera")
        self._grid = PixelGrid() if grid is None else grid
        self._cameras = {name: _Camera.FromDrake(camera) for name, camera in cameras.items()}
        for name in cameras:
            self.DeclareAbstractInputPort(f"color_image_{name}", Value(ImageRgba8U()))
            self.DeclareAbstractInputPort(f"depth_image_{name}", Value(ImageDepth32F()))
            self.DeclareAbstractInputPort(f"body_pose_in_world_{name}", Value(RigidTransform()))
        blank = np.zeros((4, *self._grid.shape), np.float32)
        self.DeclareAbstractOutputPort(
            "observation",
            lambda: AbstractValue.Make(Observation(image=blank, grid=self._grid)),
            self._CalcObservation,
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _CalcObservation(self, context: Context, output: AbstractValue) -> None:
        views = []
        for name, camera in self._cameras.items():
            X_WB: Any = self.GetInputPort(f"body_pose_in_world_{name}").Eval(context)
            color = self._EvalImage(context, f"color_image_{name}", camera)
            depth = self._EvalImage(context, f"depth_image_{name}", camera)
            views.append(_see(color.reshape(-1, 4), depth[:, :, 0], X_WB, camera, self._grid))
        image, valid = _fuse(np.stack(views))
        image.flags.writeable = valid.flags.writeable = False
        output.set_value(Observation(image=image, grid=self._grid, valid=valid))

    def _EvalImage(self, context: Context, port: str, camera: "_Camera") -> NDArray:
        """The image's data, (height, width, channels)."""
        image: Any = self.GetInputPort(port).Eval(context)
        data = np.asarray(image.data)
        height, width = camera.v.size, camera.u.size
        if data.shape[:2] != (height, width):
            raise ValueError(
                f"{port} of HeightmapProjector is {data.shape[1]}x{data.shape[0]} pixels (width x "
                f"height), but its camera was declared as {width}x{height}"
            )
        return data


class _Camera(NamedTuple):
    """A depth camera in the form that the projection needs."""

    u: NDArray[np.float32]
    """(width,): x of the ray through each column at depth 1."""
    v: NDArray[np.float32]
    """(height,): y of the ray through each row at depth 1."""
    min_depth: float
    max_depth: float
    X_BD: RigidTransform

    @staticmethod
    def FromDrake(camera: DepthRenderCamera) -> "_Camera":
        core = camera.core()
        info = core.intrinsics()
        u = (np.arange(info.width()) + 0.5 - info.center_x()) / info.focal_x()
        v = (np.arange(info.height()) + 0.5 - info.center_y()) / info.focal_y()
        return _Camera(
            u=u.astype(np.float32),
            v=v.astype(np.float32),
            min_depth=camera.depth_range().min_depth(),
            max_depth=camera.depth_range().max_depth(),
            X_BD=RigidTransform(core.sensor_pose_in_camera_body()),
        )


def _see(
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    X_WB: RigidTransform,
    camera: _Camera,
    grid: PixelGrid,
) -> NDArray[np.float32]:
    """One camera's heightmap: (4, rows, cols) red, green, blue, height; height -1 where unseen.

    `PixelGrid.to_pixel` is affine, as is the rigid transform: so they are applied once, to the
    camera's centre and axes, and a pixel's grid coordinates are then linear in its depth.
    """
    X_WD = X_WB.multiply(camera.X_BD)
    p_WD = X_WD.translation()
    ends = X_WD.multiply(np.eye(3)).T  # World points one metre along each axis of the camera.
    origin = np.append(grid.to_pixel(p_WD[:2]), p_WD[2] - grid.z_min)
    axes = np.column_stack([grid.to_pixel(ends[:, :2]), ends[:, 2] - grid.z_min]) - origin
    origin[:2] += 0.5  # So that truncation finds the pixel whose centre is nearest.

    def coordinate(k: int) -> NDArray[np.float32]:
        a, b, c = (np.float32(value) for value in axes[:, k])
        direction = np.add.outer(b * camera.v + c, a * camera.u)
        direction *= depth
        direction += np.float32(origin[k])
        return direction

    with np.errstate(invalid="ignore", over="ignore"):
        row, col, z = coordinate(0), coordinate(1), coordinate(2)
    point = np.flatnonzero(
        (depth >= camera.min_depth)
        & (depth <= camera.max_depth)
        & (row >= 0)
        & (row < grid.rows)
        & (col >= 0)
        & (col < grid.cols)
        & (z <= grid.z_max - grid.z_min)
    )
    row, col, z = (values.ravel()[point] for values in (row, col, z))
    cell = row.astype(np.int64) * grid.cols + col.astype(np.int64)

    # The bits of a float32 >= +0 are in the order of its value: with the height's bits above the
    # point's index in one integer, a single maximum finds the highest point and its colour.
    z = np.maximum(z, 0) + np.float32(0)  # Adding 0 turns -0 into +0.
    key = (z.view(np.int32).astype(np.int64) << 32) | point
    highest = np.full(grid.rows * grid.cols, -1, np.int64)
    np.maximum.at(highest, cell, key)

    view = np.zeros((4, highest.size), np.float32)
    view[3] = -1
    seen = np.flatnonzero(highest >= 0)
    view[:3, seen] = color[highest[seen] & 0xFFFFFFFF, :3].T / np.float32(255)
    view[3, seen] = (highest[seen] >> 32).astype(np.int32).view(np.float32)
    return view.reshape(4, *grid.shape)


def _fuse(views: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The Observation's image (4, rows, cols) of the cameras' (n, 4, rows, cols), and its mask."""
    height = views[:, 3].max(axis=0)
    seen = height >= 0
    on_top = (views[:, 3] >= 0) & (views[:, 3] >= height - np.float32(SAME_SURFACE))
    image = np.empty_like(views[0])
    image[:3] = (views[:, :3] * on_top[:, None]).sum(axis=0) / np.maximum(on_top.sum(axis=0), 1)
    image[3] = np.where(seen, height, 0)
    _bridge_gaps(image, seen)
    return image, seen


def _bridge_gaps(image: NDArray[np.float32], seen: NDArray[np.bool_]) -> None:
    """Fills, in place, single unseen pixels between two that belong together."""
    row, col = np.nonzero(~seen)
    padded_image = np.pad(image, ((0, 0), (1, 1), (1, 1)))
    padded_seen = np.pad(seen, 1)
    fill = np.zeros((4, row.size), np.float32)
    fill_height = np.full(row.size, -1, np.float32)
    for along_row, along_col in ((1, 0), (0, 1)):
        before = (row + 1 - along_row, col + 1 - along_col)
        after = (row + 1 + along_row, col + 1 + along_col)
        one, other = padded_image[:, *before], padded_image[:, *after]
        mean = (one + other) / 2
        bridge = padded_seen[before] & padded_seen[after]
        bridge &= np.abs(one[3] - other[3]) <= SAME_SURFACE
        bridge &= mean[3] > fill_height
        fill = np.where(bridge, mean, fill)
        fill_height = np.where(bridge, mean[3], fill_height)
    image[:, row, col] = fill
    seen[row, col] = fill_height >= 0
