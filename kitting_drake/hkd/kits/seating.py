"""Finds the pose of a tool in a cavity that was made for another outline of the tool, such as one
traced from a photo."""

import math
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import cKDTree

Points = NDArray[np.float64]

_STEP = 0.0004
"""The spacing of points along a tool's outline, in metres."""
_WALL_STEP = 0.0001
"""The spacing of points along a cavity's wall, in metres."""
_MOST_MOVE = 0.001
"""The largest move in one round of the search in `find_seat`, in metres."""
_ROUNDS = 12
_SETTLED = 1e-6
"""The search ends when a round increases `Seat.room` by no more than this, in metres."""


@dataclass(frozen=True)
class Seat:
    """The pose of a tool in a cavity, in the frame C of the tool for which the cavity was made."""

    x: float
    y: float
    yaw: float
    """The rotation about C's z, in radians."""
    room: float
    """The least distance between the tool's outline and the wall, in metres; negative if the tool
    does not fit."""


def find_seat(tool: CrossSection, model: CrossSection, cavity: CrossSection) -> Seat:
    """Finds the pose at which a tool has the most room in a cavity.

    The search starts where the outlines `tool` and `model` agree best.

    Args:
        tool: the outline of the tool, in its own frame, in metres.
        model: the outline for which the cavity was made, in C, in metres.
        cavity: the outline of the cavity's walls, in C, in metres.
    """
    points = _samples(_outer(tool), _STEP)[0]
    x, y, yaw = _aligned(points, _samples(_outer(model), _STEP)[0])
    walls, normals = _samples(cavity, _WALL_STEP)
    tree = cKDTree(walls)
    best = Seat(x, y, yaw, -math.inf)
    for _ in range(_ROUNDS):
        placed = _moved(points, x, y, yaw)
        nearest = tree.query(placed)[1]
        gaps = ((placed - walls[nearest]) * normals[nearest]).sum(axis=1)
        if gaps.min() <= best.room + _SETTLED:
            break
        best = Seat(x, y, yaw, float(gaps.min()))
        middle, reach = placed.mean(axis=0), float(np.ptp(placed, axis=0).max()) / 2
        turned = (placed - middle)[:, ::-1] * [-1, 1]
        rows = np.column_stack(
            [-normals[nearest], -(turned * normals[nearest]).sum(axis=1), np.ones(len(gaps))]
        )
        limits = [(-_MOST_MOVE, _MOST_MOVE)] * 2 + [(-_MOST_MOVE / reach, _MOST_MOVE / reach)]
        found = linprog([0, 0, 0, -1], A_ub=rows, b_ub=gaps, bounds=[*limits, (None, None)])
        if not found.success:
            break
        dx, dy, turn, _ = found.x
        c, s = math.cos(turn), math.sin(turn)
        x, y = np.array([[c, -s], [s, c]]) @ (np.array([x, y]) - middle) + middle + (dx, dy)
        yaw += turn
    return best


def _outer(outline: CrossSection) -> CrossSection:
    """Returns an outline without its holes."""
    return CrossSection([loop for part in outline.decompose() for loop in part.to_polygons()[:1]])


def _samples(outline: CrossSection, step: float) -> tuple[Points, Points]:
    """Returns points (n, 2) at even distances along an outline, and the normals (n, 2) that point
    into it."""
    points, normals = [], []
    for loop in outline.to_polygons():
        start = np.asarray(loop, float)
        edges = np.roll(start, -1, axis=0) - start
        lengths = np.linalg.norm(edges, axis=1)
        counts = np.maximum(1, np.ceil(lengths / step)).astype(int)
        shares = np.concatenate([np.arange(count) / count for count in counts])
        points.append(
            np.repeat(start, counts, axis=0) + shares[:, None] * np.repeat(edges, counts, axis=0)
        )
        inward = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.maximum(lengths, 1e-12)[:, None]
        normals.append(np.repeat(inward, counts, axis=0))
    return np.concatenate(points), np.concatenate(normals)


def _moved(points: Points, x: float, y: float, yaw: float) -> Points:
    c, s = math.cos(yaw), math.sin(yaw)
    return points @ np.array([[c, s], [-s, c]]) + (x, y)


def _aligned(points: Points, target: Points) -> tuple[float, float, float]:
    """Returns the x, y and yaw that move points (n, 2) onto target points.

    They are found by the iterative closest point algorithm, which starts at each quarter turn.
    """
    tree = cKDTree(target)
    best, least = (0.0, 0.0, 0.0), math.inf
    for quarter in range(4):
        yaw = quarter * math.pi / 2
        x, y = target.mean(axis=0) - _moved(points, 0, 0, yaw).mean(axis=0)
        for _ in range(40):
            goal = target[tree.query(_moved(points, x, y, yaw))[1]]
            a, b = points - points.mean(axis=0), goal - goal.mean(axis=0)
            yaw = math.atan2(
                float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum())
            )
            x, y = goal.mean(axis=0) - _moved(points, 0, 0, yaw).mean(axis=0)
        moved = _moved(points, x, y, yaw)
        error = float(tree.query(moved)[0].mean() + cKDTree(moved).query(target)[0].mean())
        if error < least:
            best, least = (float(x), float(y), yaw), error
    return best
