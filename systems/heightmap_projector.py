"""Projects the cameras' images to the orthographic heightmap that policies observe."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import DepthRenderCamera
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from systems.heightmap import DepthRays, View, project
from systems.signals import Observation, PixelGrid
from systems.weak_calc import weak_calc


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
        - heights

    There are three input ports for each camera. They take the outputs `color_image`,
    `depth_image_32f` and `body_pose_in_world` (X_WB) of an RgbdSensor. Each output port holds an
    Observation. It is computed on demand and cached until an input changes. Its image is read-only,
    because all readers share it. The port `heights` has black colours, so that evaluating it does
    not render colour images.

    The law, for a camera D with intrinsics (fx, fy, cx, cy) and fixed pose X_BD in the sensor body:

    - Image pixel (u, v) covers [u, u+1) x [v, v+1), so its ray passes through (u + 1/2, v + 1/2):
      `p_WP = X_WB X_BD (depth * ((u + 1/2 - cx)/fx, (v + 1/2 - cy)/fy, 1))`. Drake's VTK engine
      renders the same way, to a hundredth of a pixel. NaN and depths outside the camera's
      DepthRange, such as Drake's too close (0) and too far (infinity), are ignored.
    - Points off the grid, above `z_max`, or more than 5 cm below `z_min` are dropped. In each grid
      pixel, a camera's highest point determines height and colour.
    - The fused height is the maximum over the cameras. The fused colour is the mean over the
      cameras that see the top surface, which are those whose height is within SAME_SURFACE (1 cm)
      of the fused height. The other cameras see a side of the object, or the ground in front.
    - A table that seems tilted by up to 2 degrees, or up to 1 cm off `z_min`, is levelled: its
      plane is subtracted (`table_plane.find_table`). Points below the levelled table get height 0.
    - A pixel is `in_view` if it is in some camera's image at the height `z_min`.
    - A camera's samples can be farther apart than grid pixels. An unseen pixel is interpolated if
      both of its neighbours along x or along y are seen, with heights within SAME_SURFACE of each
      other. It gets the mean of these two neighbours. If the neighbours along x and those along y
      qualify, it gets the larger mean. Wider gaps (shadows) remain zero in all four channels and
      are not `valid`.
    - Where a surface ends on the side that faces away from an oblique camera, the edge is assumed
      to be midway between two samples. The heights of these edges are in `edge_height` (see
      `surface_edges`), not in the image.

    The colour camera must be registered with the depth camera: same intrinsics, same pose.
    """

    def __init__(
        self, *, cameras: Mapping[str, DepthRenderCamera], grid: PixelGrid | None = None
    ) -> None:
        """
        Args:
            cameras: the depth camera of each sensor by name, as passed to `RgbdSensor`.
            grid: the pixels of the heightmap; None for the default grid.

        Raises:
            ValueError: there is no camera.
        """
        super().__init__()
        if not cameras:
            raise ValueError("HeightmapProjector needs at least one camera")
        self._grid = PixelGrid() if grid is None else grid
        self._rays = {name: _rays(camera) for name, camera in cameras.items()}
        self._X_BD = {
            name: RigidTransform(camera.core().sensor_pose_in_camera_body())
            for name, camera in cameras.items()
        }
        for name in cameras:
            self.DeclareAbstractInputPort(f"color_image_{name}", Value(ImageRgba8U()))
            self.DeclareAbstractInputPort(f"depth_image_{name}", Value(ImageDepth32F()))
            self.DeclareAbstractInputPort(f"body_pose_in_world_{name}", Value(RigidTransform()))
        shape_inputs = {
            self.GetInputPort(f"{port}_{name}").ticket()
            for port in ("depth_image", "body_pose_in_world")
            for name in cameras
        }
        blank = Observation(np.zeros((4, *self._grid.shape), np.float32), self._grid)
        for port, in_color, prerequisites in (
            ("observation", True, {self.all_input_ports_ticket()}),
            ("heights", False, shape_inputs),
        ):
            self.DeclareAbstractOutputPort(
                port,
                lambda: AbstractValue.Make(blank),
                weak_calc(self._CalcObservation, in_color),
                prerequisites_of_calc=prerequisites,
            )

    def _CalcObservation(self, in_color: bool, context: Context, output: AbstractValue) -> None:
        views = []
        for name, rays in self._rays.items():
            X_WB: Any = self.GetInputPort(f"body_pose_in_world_{name}").Eval(context)
            color = self._EvalImage(context, f"color_image_{name}", rays) if in_color else None
            depth = self._EvalImage(context, f"depth_image_{name}", rays)
            X_WD = X_WB.multiply(self._X_BD[name]).GetAsMatrix4()
            views.append(View(color, depth[:, :, 0], X_WD, rays))
        output.set_value(project(views, self._grid))

    def _EvalImage(self, context: Context, port: str, rays: DepthRays) -> NDArray:
        """The image (height, width, channels) of an input port."""
        image: Any = self.GetInputPort(port).Eval(context)
        data = np.asarray(image.data)
        height, width = rays.shape
        if data.shape[:2] != (height, width):
            raise ValueError(
                f"{port} of HeightmapProjector is {data.shape[1]}x{data.shape[0]} pixels (width x "
                f"height), but its camera was declared as {width}x{height}"
            )
        return data


def _rays(camera: DepthRenderCamera) -> DepthRays:
    info, depth_range = camera.core().intrinsics(), camera.depth_range()
    return DepthRays.from_pinhole(
        size=(info.width(), info.height()),
        focal=(info.focal_x(), info.focal_y()),
        centre=(info.center_x(), info.center_y()),
        depth_range=(depth_range.min_depth(), depth_range.max_depth()),
    )
