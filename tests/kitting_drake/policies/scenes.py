"""Synthetic training scenes: a tool of a few blocks, and a kit with a recess for it."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.images import Image, LabelledImage, rotation_matrix
from kitting_drake.policies.data.recorded import Recorded
from kitting_drake.policies.networks.architecture import NetworkConfig
from systems.signals import Observation, PixelGrid

SIDE = 113
ORIENTATIONS = 36
ROOM = 8
"""The largest shift of a scene, in pixels. It moves at most the tip of a corner of the kit out of
the image."""

_BLOCK = 4.0
"""The side of a block, in pixels."""
_APART = 22
"""The distance from the image's centre to the tool, and to the recess, in pixels."""
_FINE = 4
"""The number of samples per pixel along each axis; a pixel is the mean of its samples."""

_Blocks = frozenset[tuple[int, int]]
_HANDLE: _Blocks = frozenset((i, 0) for i in range(-4, 1))
_BESIDE = ((0, -1), (0, 1), (1, -1), (1, 1))
_KIT: _Blocks = frozenset((i, j) for i in range(-5, 4) for j in range(-3, 4))


def stored_observation(name: str) -> Observation:
    """A rendered observation from the file beside the tests.

    `rgb` (3, rows, cols), 8 bits, and `height_tenth_mm` (rows, cols), in tenths of a millimetre.

    Args:
        name: `kitting_seen`, `kitting_unseen` or `kitting_unseen_final`.
    """
    stored = np.load(Path(__file__).parent / "observations" / f"{name}.npz")
    recorded = Recorded(stored["rgb"], stored["height_tenth_mm"].astype(np.float32) * 1e-4)
    return Observation(recorded.image, PixelGrid())


def config(method: str, *, stop: bool = False) -> NetworkConfig:
    """The config of the smallest networks, with a normalisation that keeps empty pixels zero."""
    return NetworkConfig(
        method=method,
        preset="tiny",
        orientations=ORIENTATIONS,
        colour_mean=0.0,
        colour_std=0.5,
        height_mean=0.0,
        height_std=0.02,
        stop=stop,
    )


def scene(seed: int, degrees: float = 0.0) -> LabelledImage:
    """A scene that is rendered at a rotation, so that its image is not resampled.

    The tool is picked at its neck, along its handle. Without rotation the labels lie on pixels and
    bins.

    Args:
        seed: the random seed of the tool and of all poses.
        degrees: the rotation of the scene about its centre, counter-clockwise.
    """
    return _scene(seed, degrees, placed=False)


def final_scene(seed: int, degrees: float = 0.0) -> Image:
    """The image of `scene` after the tool was placed into its recess; nothing is left to pick.

    Returns:
        Colours and heights (4, SIDE, SIDE).
    """
    return _scene(seed, degrees, placed=True).image


def _scene(seed: int, degrees: float, *, placed: bool) -> LabelledImage:
    random = np.random.default_rng(seed)
    tool = _tool(random)
    bins = random.integers(ORIENTATIONS, size=3)
    pick_angle, place_angle, at = bins * math.tau / ORIENTATIONS
    offset = np.rint(rotation_matrix(at) @ np.array([_APART, 0]))

    rotation = math.radians(degrees)
    middle = np.full(2, (SIDE - 1) / 2)
    pick = middle + rotation_matrix(rotation) @ offset
    place = middle - rotation_matrix(rotation) @ offset
    pick_angle, place_angle = pick_angle + rotation, place_angle + rotation
    height, colour = np.zeros((2, SIDE * _FINE, SIDE * _FINE))
    kit, cavity = _filled(place, place_angle, _KIT), _filled(place, place_angle, tool)
    height[kit & ~cavity], colour[kit] = 0.03, 0.4
    seen = cavity if placed else _filled(pick, pick_angle, tool)
    height[seen], colour[seen] = 0.02, 1.0
    points = np.stack([colour, colour, colour, height])
    image = points.reshape(4, SIDE, _FINE, SIDE, _FINE).mean(axis=(2, 4))
    return LabelledImage(
        image=image.astype(np.float32),
        pick=pick,
        pick_theta=float(pick_angle),
        place=place,
        rotation=float(place_angle - pick_angle),
    )


def _tool(random: np.random.Generator) -> _Blocks:
    """A random tool without mirror symmetry: a handle, and a head of three blocks."""
    while True:
        chosen = random.choice(len(_BESIDE), 2, replace=False)
        head = {_BESIDE[index] for index in chosen}
        if head != {(row, -col) for row, col in head}:
            return _HANDLE | head | {(1, 0)}


def _filled(centre: NDArray[np.float64], angle: float, blocks: _Blocks) -> NDArray[np.bool_]:
    """(SIDE * _FINE, SIDE * _FINE): the samples inside blocks that are rotated about `centre`."""
    points = (np.arange(SIDE * _FINE) + 0.5) / _FINE - 0.5
    grid = np.stack(np.meshgrid(points, points, indexing="ij"), axis=-1)
    row, col = np.rint((grid - centre) @ rotation_matrix(angle) / _BLOCK).astype(int).clip(-6, 6).T
    inside = np.zeros((13, 13), bool)
    for block in blocks:
        inside[block[0] + 6, block[1] + 6] = True
    return inside[row + 6, col + 6].T
