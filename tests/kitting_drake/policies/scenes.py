"""Made-up scenes to learn: a blocky shape somewhere, and a cavity like it somewhere else."""

import math

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.config import NetworkConfig
from kitting_drake.policies.images import LabelledImage, rotation

SIDE = 81
ORIENTATIONS = 36

_CELL = 4.0
"""Side of the blocks, in pixels."""
_APART = 19
"""Distance of the shape and of the cavity from the middle of the image, in pixels."""


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


def scene(seed: int) -> LabelledImage:
    """A scene: it may be turned about its middle by any angle, and nothing leaves it.

    The labels lie on pixels and bins. The shape is picked by one of its blocks, along its own
    first axis, and goes into the cavity.
    """
    random = np.random.default_rng(seed)
    cells = _shape(random)
    height, colour = np.zeros((2, SIDE, SIDE))
    bins = random.integers(ORIENTATIONS, size=3)
    pick_angle, place_angle, at = bins * math.tau / ORIENTATIONS
    offset = rotation(at) @ np.array([_APART, 0])
    middle = np.full(2, (SIDE - 1) / 2)
    pick, place = np.rint(middle + offset), np.rint(middle - offset)

    block = _filled(place, place_angle, {(i, j) for i in range(-3, 4) for j in range(-3, 4)})
    cavity = _filled(place, place_angle, cells)
    shape = _filled(pick, pick_angle, cells)
    height[block & ~cavity], colour[block] = 0.03, 0.4
    height[shape], colour[shape] = 0.02, 1.0
    return LabelledImage(
        image=np.stack([colour, colour, colour, height]).astype(np.float32),
        pick=pick,
        pick_theta=float(pick_angle),
        place=place,
        turn=float(place_angle - pick_angle),
    )


def _shape(random: np.random.Generator) -> set[tuple[int, int]]:
    """Seven blocks that hang together, around (0, 0), and look different after every turn."""
    while True:
        cells = {(0, 0)}
        while len(cells) < 7:
            row, col = sorted(cells)[random.integers(len(cells))]
            down, right = [(0, 1), (1, 0), (0, -1), (-1, 0)][random.integers(4)]
            if max(abs(row + down), abs(col + right)) <= 2:
                cells.add((row + down, col + right))
        turned = {(-row, -col) for row, col in cells}
        if len(cells & turned) <= 3:
            return cells


def _filled(
    centre: NDArray[np.float64], angle: float, cells: set[tuple[int, int]]
) -> NDArray[np.bool_]:
    """Which pixels lie in some blocks around a centre, turned."""
    pixels = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"), axis=-1)
    local = np.rint((pixels - centre) @ rotation(angle) / _CELL + 1e-9).astype(int)
    return np.array([tuple(cell) in cells for cell in local.reshape(-1, 2)]).reshape(SIDE, SIDE)
