r"""Kinematics of a Franka arm whose hand points straight down.

Both models, FR3 and Panda, have the same kinematics. In Craig's convention the transform of joint i
is Rot_x(alpha) Trans_x(a) Rot_z(q) Trans_z(d); source: Franka's FCI documentation,
"Denavit-Hartenberg parameters". The Franka Hand is mounted at the flange, rotated about z by -pi/4.

Frames: B is the arm's base, F its flange, G the gripper frame of `systems.hand_geometry`. A hand
pose is (x, y, z, yaw) of G in the world: its z axis points up, its x axis along
(cos yaw, sin yaw). The axis of joint 7 then points down, so a rotation of joint 7 by -a turns the
hand by a yaw of +a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.arm_limits import JOINTS
from systems.hand_geometry import FINGERTIP_DISTANCE

_D1, _D3, _D5, _D_FLANGE = 0.333, 0.316, 0.384, 0.107
_A4, _A7 = 0.0825, 0.088
HAND_TURN = -math.pi / 4
"""Rotation of the hand about the flange's z axis, in rad."""
_A = (0.0, 0.0, 0.0, _A4, -_A4, 0.0, _A7)
_D = (_D1, 0.0, _D3, 0.0, _D5, 0.0, 0.0)
_TWIST = (0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0)
"""sin(alpha) of each joint's Denavit-Hartenberg twist; cos(alpha) is 1 for joint 1 and 0 for the
other joints."""
_HAND_X = (math.cos(HAND_TURN), math.sin(HAND_TURN))
"""The hand's x axis, as x and y components in the flange's frame."""
TIP_DISTANCE = _D_FLANGE + FINGERTIP_DISTANCE
"""Distance from the axis of joint 6 to the fingertip ends, along the axis of joint 7, in m."""

_UPPER, _FORE = math.hypot(_D3, _A4), math.hypot(_D5, _A4)
"""Distances from the elbow (the axis of joint 4) to the shoulder and to the wrist, in m."""
BRANCHES = 8


@dataclass(frozen=True)
class ArmBase:
    """Pose of the arm's base frame B in the world: x, y, z in m and yaw in rad; B's z axis points
    up."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0

    def to_base(self, pose: ArrayLike) -> NDArray[np.float64]:
        """Transforms hand poses (..., 4), as x, y, z, yaw in m and rad, from the world to B."""
        x, y, z, yaw = np.moveaxis(np.asarray(pose, dtype=float), -1, 0)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = x - self.x, y - self.y
        return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, z - self.z, yaw - self.yaw], -1)

    def to_base_points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transforms points (..., 3) from the world to B, in m."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return (points - (self.x, self.y, self.z)) @ rotation

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transforms points (..., 3) from B to the world, in m."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        rotation = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return points @ rotation + (self.x, self.y, self.z)


def joint_frames(q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Forward kinematics of all joints and the flange.

    Args:
        q: (..., 7) joint positions, in rad.

    Returns:
        (..., 8, 3, 3) rotations and (..., 8, 3) origins, in m, of the frames of the seven joints
        and of the flange, in B. The z axis of a joint's frame is the joint's axis.
    """
    shape = np.shape(q)[:-1]
    rotations, origins = np.empty((*shape, 8, 3, 3)), np.empty((*shape, 8, 3))
    cos, sin = np.cos(q), np.sin(q)
    x, y, z = (np.broadcast_to(axis, (*shape, 3)) for axis in np.eye(3))
    origin = np.zeros((*shape, 3))
    for i in range(JOINTS):
        origin = origin + _A[i] * x
        if _TWIST[i]:
            y, z = _TWIST[i] * z, -_TWIST[i] * y
        origin = origin + _D[i] * z
        c, s = cos[..., i, None], sin[..., i, None]
        x, y = c * x + s * y, c * y - s * x
        rotations[..., i, :, 0], rotations[..., i, :, 1], rotations[..., i, :, 2] = x, y, z
        origins[..., i, :] = origin
    rotations[..., 7, :, :] = rotations[..., 6, :, :]
    origins[..., 7, :] = origin + _D_FLANGE * z
    return rotations, origins


def fingertips(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) the point midway between the fingertip ends in B, in m, at joint positions
    (..., 7)."""
    x = y = np.zeros(np.shape(q)[:-1])
    z = x + TIP_DISTANCE
    cos, sin = np.cos(q), np.sin(q)
    for i in reversed(range(JOINTS)):
        c, s = cos[..., i], sin[..., i]
        x, y, z = c * x - s * y + _A[i], s * x + c * y, z + _D[i]
        if _TWIST[i]:
            y, z = -_TWIST[i] * z, _TWIST[i] * y
    return np.stack([x, y, z], -1)


def uprightness(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) cosine of the angle between the hand's axis and straight down, at joint positions
    (..., 7)."""
    x = y = np.zeros(np.shape(q)[:-1])
    z = x + 1.0
    cos, sin = np.cos(q), np.sin(q)
    for i in reversed(range(JOINTS)):
        c, s = cos[..., i], sin[..., i]
        x, y = c * x - s * y, s * x + c * y
        if _TWIST[i]:
            y, z = -_TWIST[i] * z, _TWIST[i] * y
    return -z


def jacobian(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 6, 7) Jacobian at joint positions (..., 7), in B: three rows of angular velocity, then
    three of the fingertips' translational velocity."""
    rotations, origins = joint_frames(q)
    axes = rotations[..., :7, :, 2]
    tip = origins[..., 6, None, :] + TIP_DISTANCE * rotations[..., 6, None, :, 2]
    moments = np.cross(axes, tip - origins[..., :7, :])
    return np.concatenate([axes, moments], -1).swapaxes(-1, -2)


def hand_state(q: list[float], v: list[float], base: ArmBase) -> list[float]:
    """Pose of the hand in the world, as x, y, z, yaw in m and rad, then the rates of these four.

    If the hand does not point straight down, the yaw is the direction of its x axis as seen from
    above. The computation uses plain floats, which is faster for a call at every step.

    Args:
        q: seven joint positions, in rad.
        v: seven joint velocities, in rad/s.
        base: pose of the arm's base in the world.
    """
    # Transform the hand's position p, its x axis h and their rates joint by joint, from frame 7 to
    # frame 1.
    px = py = 0.0
    pz, hx, hy, hz = TIP_DISTANCE, _HAND_X[0], _HAND_X[1], 0.0
    dpx = dpy = dpz = dhx = dhy = dhz = 0.0
    for angle, rate, a, d, twist in zip(
        reversed(q), reversed(v), _A[::-1], _D[::-1], _TWIST[::-1], strict=True
    ):
        c, s = math.cos(angle), math.sin(angle)
        px, py, dpx, dpy = c * px - s * py, s * px + c * py, c * dpx - s * dpy, s * dpx + c * dpy
        hx, hy, dhx, dhy = c * hx - s * hy, s * hx + c * hy, c * dhx - s * dhy, s * dhx + c * dhy
        dpx, dpy, dhx, dhy = dpx - rate * py, dpy + rate * px, dhx - rate * hy, dhy + rate * hx
        px, pz = px + a, pz + d
        if twist:
            py, pz, dpy, dpz = -twist * pz, twist * py, -twist * dpz, twist * dpy
            hy, hz, dhy, dhz = -twist * hz, twist * hy, -twist * dhz, twist * dhy
    cos, sin = math.cos(base.yaw), math.sin(base.yaw)
    return [
        base.x + cos * px - sin * py,
        base.y + sin * px + cos * py,
        base.z + pz,
        math.remainder(math.atan2(hy, hx) + base.yaw, math.tau),
        cos * dpx - sin * dpy,
        sin * dpx + cos * dpy,
        dpz,
        (hx * dhy - hy * dhx) / (hx * hx + hy * hy),
    ]


def joint_seven(wrist: ArrayLike, yaw: ArrayLike) -> NDArray[np.float64]:
    """Position of joint 7 in (-pi, pi], in rad, at which a hand that points down has a given yaw.

    Args:
        wrist: azimuth in B from the wrist (joint 6) to the hand's vertical axis, in rad.
        yaw: the hand's yaw in B, in rad.
    """
    turn = np.asarray(wrist) - np.asarray(yaw) - HAND_TURN
    return np.pi - np.mod(np.pi - turn, math.tau)


def planar(tip: NDArray[np.float64], q7: NDArray[np.float64]) -> NDArray[np.float64]:
    """The joint positions at which the whole arm lies in the vertical plane through its base and
    the hand.

    Joints 3 and 5 are at zero. This is one of the solutions of `inverse`. It also exists when the
    elbow is straight above the shoulder, where `inverse` is singular. On a straight line in joint
    space between two such positions, the hand always points down.

    Args:
        tip: (..., 3) the point midway between the fingertip ends, in B, in m.
        q7: (...) positions of joint 7, in rad.

    Returns:
        (..., 7) joint positions in rad, NaN where the pose is out of reach. The joints' limits are
        not considered.
    """
    x, y, z = np.moveaxis(np.asarray(tip), -1, 0)
    across, up = np.hypot(x, y) - _A7, z + TIP_DISTANCE - _D1
    square = across**2 + up**2
    distance = np.sqrt(square)
    with np.errstate(invalid="ignore", divide="ignore"):
        at_elbow = np.arccos((_UPPER**2 + _FORE**2 - square) / (2 * _UPPER * _FORE))
        at_shoulder = np.arccos((_UPPER**2 + square - _FORE**2) / (2 * _UPPER * distance))
    q4 = at_elbow + math.atan2(_D3, _A4) + math.atan2(_D5, _A4) - math.tau
    q2 = np.arctan2(across, up) - at_shoulder - math.atan2(_A4, _D3)
    q1, zero = np.arctan2(y, x), np.zeros_like(q4)
    return np.stack(np.broadcast_arrays(q1, q2, zero, q4, zero, q2 - q4, q7), -1)


def inverse(
    tip: NDArray[np.float64], q7: NDArray[np.float64], yaw: NDArray[np.float64]
) -> NDArray[np.float64]:
    """All joint positions, in closed form, at which the hand points down and has a given pose.

    Args:
        tip: (..., 3) the point midway between the fingertip ends, in B, in m.
        q7: (...) positions of joint 7, the free parameter, in rad.
        yaw: (...) yaws of the hand in B, in rad.

    Returns:
        (..., 8, 7) joint positions in rad, one row for each of the 2 x 2 x 2 branches: the elbow on
            either side of the line from shoulder to wrist, two angles of joint 6, and two angles of
            the shoulder. A branch that does not exist is NaN. The joints' limits are not
            considered.
    """
    rotation = np.zeros((*np.shape(q7), 3, 3))
    # The flange's x axis is the hand's, rotated back by the mounting angle. The flange's z axis
    # points down.
    angle = np.asarray(yaw) + HAND_TURN
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(angle)
    rotation[..., 1, 0] = np.sin(angle)
    rotation[..., 0, 1] = np.sin(angle)
    rotation[..., 1, 1] = -np.cos(angle)
    rotation[..., 2, 2] = -1.0
    flange = np.array(tip) + np.array([0.0, 0.0, FINGERTIP_DISTANCE])
    return inverse_of_flange(rotation, flange, q7)


def inverse_of_flange(
    rotation: NDArray[np.float64], origin: NDArray[np.float64], q7: NDArray[np.float64]
) -> NDArray[np.float64]:
    """All joint positions at which the flange has a given pose. The flange need not point down.

    Args:
        rotation: (..., 3, 3) rotations of the flange in B.
        origin: (..., 3) origins of the flange in B, in m.
        q7: (...) positions of joint 7, the free parameter, in rad.

    Returns:
        (..., 8, 7) joint positions by branch, as `inverse` returns them.
    """
    # x, y and z7 are the axes of frame 7.
    x, y, z7 = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    c, s = np.cos(q7)[..., None], np.sin(q7)[..., None]
    x6, z6 = c * x - s * y, c * y + s * x
    # Frame 7 is frame 6, turned by pi/2 about x and then by q7 about z. So x6 and z6 are the x and
    # y axes of frame 7 turned back by q7, and y6 is -z7.
    y6 = -z7
    wrist = origin - _D_FLANGE * z7 - _A7 * x6
    shoulder = np.array([0.0, 0.0, _D1])
    reach = shoulder - wrist
    distance = np.linalg.norm(reach, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        toward = reach / distance
        at_wrist = np.arccos((distance**2 + _FORE**2 - _UPPER**2) / (2 * distance * _FORE))
        # `between` is the angle between `toward` and -z5, the axis of the forearm.
        between = math.atan2(_A4, _D5) + _ELBOW * at_wrist
        # Compute -z5, which lies in the plane of x6 and y6.
        along_x, along_y = np.sum(toward * x6, -1), np.sum(toward * y6, -1)
        spread = np.arccos(np.cos(between) / np.hypot(along_x, along_y)[..., None])
        angle = np.arctan2(along_y, along_x)[..., None] + _WRIST * spread
        x6, y6, z6 = x6[..., None, :], y6[..., None, :], z6[..., None, :]
        z5 = -np.cos(angle)[..., None] * x6 - np.sin(angle)[..., None] * y6
        # z4 is normal to the plane of shoulder, elbow and wrist.
        z4 = _cross(toward[..., None, :], z5) / np.sin(between)[..., None]
    six = _angles(wrist[..., None, :] - shoulder, x6, z6, z5, z4)
    seven = np.broadcast_to(np.asarray(q7)[..., None, None], (*six.shape[:-1], 1))
    return np.concatenate([six, seven], -1)


_ELBOW = np.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0])
_WRIST = np.array([1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
_SHOULDER = np.array([1.0, -1.0] * 4)
"""The signs of the elbow's side, of joint 6's angle and of the shoulder's angle in each of the
eight branches."""


def _angles(
    wrist: NDArray[np.float64],
    x6: NDArray[np.float64],
    z6: NDArray[np.float64],
    z5: NDArray[np.float64],
    z4: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(..., 8, 6) positions of joints 1 to 6, by branch.

    Args:
        wrist: (..., 1, 3) vector from the shoulder to the wrist in B, in m.
        x6: (..., 1, 3) x axis of frame 6 in B.
        z6: (..., 1, 3) z axis of frame 6 in B.
        z5: (..., 8, 3) z axis of frame 5 in B.
        z4: (..., 8, 3) z axis of frame 4 in B.
    """
    x4, x5 = _cross(z5, z4), _cross(z5, z6)
    elbow = (wrist - _D5 * z5 + _A4 * x4) / _UPPER**2
    across = _cross(z4, elbow)
    z3, x3 = _D3 * elbow + _A4 * across, _A4 * elbow - _D3 * across
    q2 = _SHOULDER * np.arctan2(np.hypot(z3[..., 0], z3[..., 1]), z3[..., 2])
    q1 = np.arctan2(_SHOULDER * z3[..., 1], _SHOULDER * z3[..., 0])
    c1, s1, c2, s2 = np.cos(q1), np.sin(q1), np.cos(q2), np.sin(q2)
    along_x2 = c2 * (c1 * x3[..., 0] + s1 * x3[..., 1]) - s2 * x3[..., 2]
    q3 = np.arctan2(c1 * x3[..., 1] - s1 * x3[..., 0], along_x2)
    q4 = np.arctan2(np.sum(x4 * z3, -1), np.sum(x4 * x3, -1))
    q5 = np.arctan2(-np.sum(x5 * z4, -1), np.sum(x5 * x4, -1))
    q6 = np.arctan2(np.sum(x6 * z5, -1), np.sum(x6 * x5, -1))
    # The range of joint 6 extends beyond pi, so shift its angles.
    q6 = np.where(q6 < -np.pi / 2, q6 + math.tau, q6)
    return np.stack([q1, q2, q3, q4, q5, q6], -1)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross products of vectors (..., 3), several times faster than np.cross."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        -1,
    )
