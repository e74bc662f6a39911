"""Made-up scenes to learn: a tool of a few blocks, and a kit with a cavity like it."""

import math

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.config import NetworkConfig
from kitting_drake.policies.images import LabelledImage, rotation

SIDE = 113
ORIENTATIONS = 36
ROOM = 8
"""By how many pixels a scene may be shifted, however turned: at most the tip of a corner leaves."""

_BLOCK = 4.0
"""Side of the blocks, in pixels."""
_APART = 22
"""Distance of the tool and of the cavity from the middle of the image, in pixels."""
_FINE = 4
"""A pixel shows the mean of so many points along each side of it, as a camera's does."""

_Blocks = frozenset[tuple[int, int]]
_HANDLE: _Blocks = frozenset((i, 0) for i in range(-4, 1))
_BESIDE = ((0, -1), (0, 1), (1, -1), (1, 1))
_KIT: _Blocks = frozenset((i, j) for i in range(-5, 4) for j in range(-3, 4))


def config(method: str) -> NetworkConfig:
    """For which all that is empty is zero, in the image and beyond its edges."""
    return NetworkConfig(
        method=method,
        preset="tiny",
        orientations=ORIENTATIONS,
        colour_mean=0.0,
        colour_deviation=0.5,
        height_mean=0.0,
        height_deviation=0.02,
    )


def scene(seed: int, degrees: float = 0.0) -> LabelledImage:
    """A scene, turned about its middle and then looked at: no image is turned.

    The tool is picked by its neck, along its handle. The labels of scenes that are not turned lie
    on pixels and bins.

    Args:
        seed: of the tool and of where all lies.
        degrees: counter-clockwise.
    """
    random = np.random.default_rng(seed)
    tool = _tool(random)
    bins = random.integers(ORIENTATIONS, size=3)
    pick_angle, place_angle, at = bins * math.tau / ORIENTATIONS
    offset = np.rint(rotation(at) @ np.array([_APART, 0]))

    turn = math.radians(degrees)
    middle = np.full(2, (SIDE - 1) / 2)
    pick, place = middle + rotation(turn) @ offset, middle - rotation(turn) @ offset
    pick_angle, place_angle = pick_angle + turn, place_angle + turn
    height, colour = np.zeros((2, SIDE * _FINE, SIDE * _FINE))
    kit, cavity = _filled(place, place_angle, _KIT), _filled(place, place_angle, tool)
    height[kit & ~cavity], colour[kit] = 0.03, 0.4
    seen = _filled(pick, pick_angle, tool)
    height[seen], colour[seen] = 0.02, 1.0
    points = np.stack([colour, colour, colour, height])
    image = points.reshape(4, SIDE, _FINE, SIDE, _FINE).mean(axis=(2, 4))
    return LabelledImage(
        image=image.astype(np.float32),
        pick=pick,
        pick_theta=float(pick_angle),
        place=place,
        turn=float(place_angle - pick_angle),
    )


def _tool(random: np.random.Generator) -> _Blocks:
    """A handle, and a head of three blocks that tells left from right."""
    while True:
        chosen = random.choice(len(_BESIDE), 2, replace=False)
        head = {_BESIDE[index] for index in chosen}
        if head != {(row, -col) for row, col in head}:
            return _HANDLE | head | {(1, 0)}


def _filled(centre: NDArray[np.float64], angle: float, blocks: _Blocks) -> NDArray[np.bool_]:
    """(SIDE * _FINE, SIDE * _FINE): which points lie in some blocks around a centre, turned."""
    points = (np.arange(SIDE * _FINE) + 0.5) / _FINE - 0.5
    grid = np.stack(np.meshgrid(points, points, indexing="ij"), axis=-1)
    row, col = np.rint((grid - centre) @ rotation(angle) / _BLOCK).astype(int).clip(-6, 6).T
    inside = np.zeros((13, 13), bool)
    for block in blocks:
        inside[block[0] + 6, block[1] + 6] = True
    return inside[row + 6, col + 6].T
