"""The types of cameras in a scenario, and their conversion to Drake's cameras.

Drake's YAML loader needs evaluated annotations, hence no `from __future__ import annotations`.
"""

import copy
import dataclasses as dc
from typing import TypeAlias

from pydrake.common.schema import Rotation, Transform
from pydrake.geometry import DepthRenderCamera
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraConfig

from kitting_drake.common.rendering import look_at
from systems.bounds import bounded

_ANGLE = (-360.0, 360.0)
_NEAR, _FAR = 0.01, 10.0
"""Depth range of `Pinhole` and `LookAt`, in metres."""


@dc.dataclass
class Pinhole:
    """An RGB-D camera placed by roll, pitch and yaw: a short form of Drake's `CameraConfig`.

    In the camera's frame, z points along the viewing direction, x to the right in the image, and y
    down.
    """

    # Position in the world, in m.
    position: list[float] = bounded([1.0, 0.0, 0.75], -10.0, 10.0)

    # Roll, pitch and yaw in degrees; the rotation is R = Rz(yaw) Ry(pitch) Rx(roll).
    rpy_deg: list[float] = bounded([45.0, 180.0, -90.0], *_ANGLE)

    # Image size in pixels, focal length in pixels; the principal point is the image's middle.
    width: int = bounded(640, 16, 4096)
    height: int = bounded(480, 16, 4096)
    focal_length: float = bounded(450.0, 10.0, 10000.0)

    def to_camera_config(self) -> CameraConfig:
        """The same camera as a `CameraConfig`."""
        rotation = Rotation(value=Rotation.Rpy(deg=self.rpy_deg))
        return _camera_config(self, Transform(translation=self.position, rotation=rotation))


@dc.dataclass
class LookAt:
    """An upright RGB-D camera aimed at a point: a short form of Drake's `CameraConfig`."""

    # Positions of the camera and of the point in the middle of the image, in the world, in m.
    position: list[float] = bounded([1.0, 0.0, 0.75], -10.0, 10.0)
    target: list[float] = bounded([0.5, 0.0, 0.0], -10.0, 10.0)

    # Image size in pixels, focal length in pixels; the principal point is the image's middle.
    width: int = bounded(640, 16, 4096)
    height: int = bounded(480, 16, 4096)
    focal_length: float = bounded(450.0, 10.0, 10000.0)

    def to_camera_config(self) -> CameraConfig:
        """The same camera as a `CameraConfig`."""
        return _camera_config(self, Transform(look_at(self.position, self.target)))

    def validate(self) -> None:
        """Checks that the camera does not look straight up or down, where its roll is undefined.

        Raises:
            ValueError: the camera looks straight up or down. The caller must put the camera's name
                before the message.
        """
        if self.position[:2] == self.target[:2]:
            raise ValueError("looks straight up or down, so its roll is undefined: use !Pinhole")


Camera: TypeAlias = Pinhole | LookAt | CameraConfig
"""The types of cameras in a scenario."""


def _camera_config(camera: Pinhole | LookAt, X_PB: Transform) -> CameraConfig:
    return CameraConfig(
        width=camera.width,
        height=camera.height,
        focal=CameraConfig.FocalLength(x=camera.focal_length, y=camera.focal_length),
        center_x=camera.width / 2,
        center_y=camera.height / 2,
        clipping_near=_NEAR,
        clipping_far=_FAR,
        z_near=_NEAR,
        z_far=_FAR,
        X_PB=X_PB,
        rgb=True,
        depth=True,
    )


def _config(camera: Camera) -> CameraConfig:
    return camera if isinstance(camera, CameraConfig) else camera.to_camera_config()


_UNUSED = ("renderer_name", "renderer_class", "fps", "capture_offset", "output_delay", "lcm_bus")
"""Fields of a CameraConfig that have no effect, because images are rendered on demand."""


def check_camera(camera: Camera) -> None:
    """Checks the constraints that types and ranges cannot express.

    Raises:
        ValueError: the camera violates a constraint. The caller must put the camera's name before
            the message.
    """
    if isinstance(camera, LookAt):
        camera.validate()
    if not isinstance(camera, CameraConfig):
        return
    plain = CameraConfig()
    for name in _UNUSED:
        if getattr(camera, name) != getattr(plain, name):
            raise ValueError(f"has the field {name}, which has no effect here: remove it")
    if camera.X_PB.base_frame not in (None, "", "world"):
        raise ValueError("must be fixed to the world: remove X_PB.base_frame")
    try:
        camera.MakeCameras()
        X_BC, X_BD = (X.GetDeterministicValue() for X in (camera.X_BC, camera.X_BD))
        camera.X_PB.GetDeterministicValue()
    except RuntimeError as error:
        raise ValueError(f"is invalid: {str(error).splitlines()[0]}") from error
    if not X_BC.IsNearlyEqualTo(X_BD, 1e-9):
        raise ValueError("must have the same pose for colour and depth: X_BC and X_BD differ")


def camera_pose(camera: Camera) -> RigidTransform:
    """The pose X_WB of a camera in the world; z is the viewing direction, x points right in the
    image, y down."""
    return RigidTransform(_config(camera).X_PB.GetDeterministicValue())


def depth_camera(camera: Camera, renderer: str) -> DepthRenderCamera:
    """Drake's depth camera for a camera of a scenario. The colour camera has the same pose.

    Args:
        camera: the camera of a scenario.
        renderer: the name of the camera's render engine.
    """
    config = copy.deepcopy(_config(camera))
    config.renderer_name = renderer
    return config.MakeCameras()[1]
