"""Cameras: from their descriptions in a scenario to Drake's."""

import numpy as np
from pydrake.geometry import ClippingRange, DepthRange, DepthRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo

from kitting_drake.common.rendering import look_at
from kitting_drake.scenario.schema import LookAt, Pinhole


def camera_pose(config: Pinhole | LookAt) -> RigidTransform:
    """X_WC of a camera: z looks, x points right in the image, y down."""
    if isinstance(config, Pinhole):
        return RigidTransform(RollPitchYaw(np.deg2rad(config.rpy_deg)), config.position)
    return look_at(config.position, config.target)


def depth_camera(config: Pinhole | LookAt, renderer: str) -> DepthRenderCamera:
    """Drake's description of a camera; colour and depth are seen from the same point."""
    info = CameraInfo(
        width=config.width,
        height=config.height,
        focal_x=config.focal_length,
        focal_y=config.focal_length,
        center_x=config.width / 2,
        center_y=config.height / 2,
    )
    core = RenderCameraCore(renderer, info, ClippingRange(0.01, 10.0), RigidTransform())
    return DepthRenderCamera(core, DepthRange(0.01, 10.0))
