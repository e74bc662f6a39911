"""The Franka hand's geometry, as `models/franka_hand` has it: the one place that owns it.

The gripper frame G: the origin midway between the fingertip ends, z up, the jaws close along y.
Lengths in metres.
"""

import numpy as np

from systems.signals import PickPlaceAction

PAD_LENGTH = 0.0176
"""Length of the pads' gripping faces along G's x."""
FINGER_LENGTH = 0.0208
"""Length of the fingers along G's x."""
FINGER_DEPTH = 0.0263
"""How far a finger reaches from its pad away from the other, along G's y, at any height above the
pads."""
FINGERTIP_DEPTH = 0.015
"""The same near the fingertip."""
MAX_OPENING = 0.080
"""Between the pads of the open jaws."""
PALM_SIZE = (0.064, 0.209)
"""Extents of the palm along G's x and y."""
FINGERTIP_DISTANCE = 0.1121
"""Distance of the fingertip ends from the hand's flange, along G's z."""
FINGER_BASE_DISTANCE = 0.0584
"""Distance of the origin of the finger meshes from the hand's flange, along G's z."""
JOINT_LIMITS = {"x": (-1.0, 1.5), "y": (-1.5, 1.5), "z": (-0.05, 1.2), "yaw": (-3.5, 3.5)}
"""Lowest and highest position of the joints that move G, in metres and rad."""


def check_reach(action: PickPlaceAction) -> None:
    """Checks that the hand can go to an action's pick, and unless it presses to its place.

    Raises:
        RuntimeError: it cannot; says which, and why.
    """
    for name, pose in action.poses.items():
        if not np.isfinite(pose.as_array()).all():
            raise RuntimeError(f"the action's {name} has no finite numbers: {pose}")
        for axis in ("x", "y"):
            value, (low, high) = getattr(pose, axis), JOINT_LIMITS[axis]
            if not low <= value <= high:
                raise RuntimeError(
                    f"the action's {name} is out of the hand's reach: {axis} is {value:g}, not "
                    f"between {low:g} and {high:g} m in the world"
                )
