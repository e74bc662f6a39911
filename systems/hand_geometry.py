"""Dimensions of the Franka hand model in `models/franka_hand`, in metres.

The gripper frame G has its origin midway between the fingertip ends. Its z axis points up, and the
jaws close along y.
"""

import numpy as np

from systems.signals import PickPlaceAction

PAD_LENGTH = 0.0176
"""Length of the pads' gripping faces along G's x."""
FINGER_LENGTH = 0.0208
"""Length of the fingers along G's x."""
FINGER_DEPTH = 0.0263
"""Extent of a finger along G's y, from its pad outwards."""
FINGERTIP_DEPTH = 0.015
"""Extent of a finger along G's y near the fingertip, from its pad outwards."""
MAX_OPENING = 0.080
"""Distance between the pads of the fully open jaws."""
PALM_SIZE = (0.064, 0.209)
"""Extents of the palm along G's x and y."""
PALM_HEIGHT = 0.0461
"""Height of the palm's underside above the fingertip ends."""
FINGERTIP_DISTANCE = 0.1121
"""Distance from the hand's flange to the fingertip ends, along G's z."""
FINGER_BASE_DISTANCE = 0.0584
"""Distance from the hand's flange to the origin of the finger meshes, along G's z."""
JOINT_LIMITS = {"x": (-1.0, 1.5), "y": (-1.5, 1.5), "z": (-0.05, 1.2), "yaw": (-3.5, 3.5)}
"""Limits of the floating hand's joints, which move G, in metres and radians."""


def check_reach(action: PickPlaceAction) -> None:
    """Checks that the hand can reach an action's pick and, unless the action presses, its
    place.

    Raises:
        RuntimeError: a pose is not finite or out of reach.
    """
    for name, pose in action.poses.items():
        if not np.isfinite(pose.as_array()).all():
            raise RuntimeError(f"the action's {name} must be finite, not {pose}")
        for axis in ("x", "y"):
            value, (low, high) = getattr(pose, axis), JOINT_LIMITS[axis]
            if not low <= value <= high:
                raise RuntimeError(
                    f"the action's {name} is out of the hand's reach: {axis} is {value:g} m, but "
                    f"must be between {low:g} and {high:g} m in the world"
                )
