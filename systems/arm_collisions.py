"""Detects collisions of a Franka arm, with capsules around its links and its hand."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.arm_kinematics import HAND_TURN, ArmBase, joint_frames
from systems.hand_geometry import FINGERTIP_DISTANCE, PALM_SIZE


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` of the line segment from `start` to `end`, in metres."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class _Link:
    """A capsule that is fixed to a frame of the arm. Frames 0 to 6 are those of joints 1 to 7, and
    frame 7 is the flange's."""

    frame: int
    capsule: Capsule


_COS, _SIN = float(np.cos(HAND_TURN)), float(np.sin(HAND_TURN))
_HALF_PALM = PALM_SIZE[1] / 2 - PALM_SIZE[0] / 2

# The links of a Franka, measured from its drawings and meshes. No point of a mesh lies more than
# 15 mm outside its capsule.
_BASE = (
    Capsule((-0.10, 0.0, 0.06), (0.0, 0.0, 0.06), 0.09),
    Capsule((0.0, 0.0, 0.06), (0.0, 0.0, 0.333), 0.08),
)
_FOREARM = _Link(4, Capsule((0.0, 0.0, -0.26), (0.0, 0.05, -0.08), 0.06))
_WRIST = _Link(5, Capsule((0.0, 0.0, -0.06), (0.0, 0.0, 0.02), 0.06))
_LAST = _Link(6, Capsule((0.0, 0.0, -0.02), (0.0, 0.0, 0.06), 0.055))
_HAND = _Link(
    7,
    Capsule(
        (_HALF_PALM * _SIN, -_HALF_PALM * _COS, 0.035),
        (-_HALF_PALM * _SIN, _HALF_PALM * _COS, 0.035),
        0.035,
    ),
)
_UPPER_ARM = _Link(2, Capsule((0.0, 0.0, -0.20), (0.0, 0.0, -0.06), 0.06))
_ELBOW = _Link(3, Capsule((0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06))
_ABOVE = (_ELBOW, _FOREARM, _WRIST, _LAST)
"""The links that could hit the table or the objects. The hand is left out, because its fingers work
among the objects."""
_OUTER = (_FOREARM, _WRIST, _LAST, _HAND)
"""The links that could hit the arm's own base."""
_HIGH = (_ELBOW, _FOREARM)
"""Those of `_ABOVE` that may be far from the hand."""
_LEAST = 0.01
"""A capsule closer than this to something else, in m, counts as colliding."""
_POINTS = 7
"""Number of cross sections of a capsule on which `link_points` places points."""


def link_points(q: NDArray[np.float64], base: ArmBase) -> NDArray[np.float64]:
    """Returns (n, 3) points on the surfaces of the arm's capsules, in m in the world, without the
    hand.

    Args:
        q: (7) joint positions, in rad.
        base: pose of the arm's base in the world.
    """
    rotations, origins = joint_frames(q)
    directions = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    lengths = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1.0)
    share = np.linspace(0.0, 1.0, _POINTS)[:, None, None]

    def points(capsule: Capsule) -> NDArray[np.float64]:
        start, end = np.array(capsule.start), np.array(capsule.end)
        around = capsule.radius * directions / lengths
        return (start + share * (end - start) + around).reshape(-1, 3)

    found = [points(capsule) for capsule in _BASE]
    for link in (_UPPER_ARM, *_ABOVE):
        placed = points(link.capsule) @ rotations[link.frame].T
        found.append(placed + origins[link.frame])
    return base.to_world(np.concatenate(found))


def collision(
    q: NDArray[np.float64],
    base: ArmBase,
    surface: float | NDArray[np.float64],
    obstacles: Sequence[Capsule] = (),
    held: float = 0.0,
    highest: float | None = None,
) -> str:
    """Names what the arm collides with at any of the given joint positions; empty if
    it does not collide.

    Args:
        q: (n, 7) joint positions, in rad.
        base: pose of the arm's base in the world.
        surface: world z of the highest surface below the wrist, in m; one for all positions, or
            (n). The hand itself is not compared with it, because the fingers must go below it.
        obstacles: capsules around bodies that do not move, in the world.
        held: how far a held object reaches from the fingertips, in m; zero if the hand is empty.
        highest: world z of the highest surface below forearm and elbow, in m; None for `surface`.
    """
    rotations, origins = joint_frames(q)

    def ends(link: _Link) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        R, p = rotations[:, link.frame], origins[:, link.frame]
        start, end = (p + R @ np.array(point) for point in (link.capsule.start, link.capsule.end))
        return start, end

    tip = (0.0, 0.0, FINGERTIP_DISTANCE)
    outer = (*_OUTER, _Link(7, Capsule(tip, tip, held))) if held else _OUTER
    placed = {link: ends(link) for link in (*_ABOVE, *outer, _UPPER_ARM)}
    for link in _ABOVE:
        lowest = np.minimum(*(end[:, 2] for end in placed[link])) - link.capsule.radius
        below = highest if highest is not None and link in _HIGH else surface
        if (lowest < below - base.z + _LEAST).any():
            return "the table or an object near the hand"
    own = [(np.array(it.start), np.array(it.end), it.radius) for it in _BASE]
    own.append((*placed[_UPPER_ARM], _UPPER_ARM.capsule.radius))
    for link in outer:
        for start, end, radius in own if link is not _FOREARM else own[:2]:
            apart = _distances(*placed[link], start, end) - link.capsule.radius - radius
            if apart.min() < _LEAST:
                return "itself"
    for obstacle in obstacles:
        start, end = base.to_base_points(np.array([obstacle.start, obstacle.end]))
        for link in (*outer, _ELBOW, _UPPER_ARM):
            apart = _distances(*placed[link], start, end) - link.capsule.radius - obstacle.radius
            if apart.min() < _LEAST:
                return "a fixed body"
    return ""


def _distances(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n) distances, in m, between the line segments from a to b and from c to d; each point is
    (n, 3) or (3)."""
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = np.sum(u * u, -1), np.sum(v * v, -1), np.sum(u * v, -1)
    uw, vw = np.sum(u * w, -1), np.sum(v * w, -1)
    tiny = 1e-12
    s = np.clip((uv * vw - vv * uw) / np.maximum(uu * vv - uv * uv, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1))
