"""Prepares objects that cannot be placed yet. This is not in the paper.

- If objects lie on or against each other and cannot be distinguished by their outlines, the topmost
  one is laid on a free part of the table.
- An object that lies upside down is turned over at an edge of the kit's block.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from kitting_drake.policies.data.images import make_action, rotation_matrix
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.jaw_clearance import failed_pixels, jaw_grasps, untried
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from systems.ledge import Ledge, moved_gripper
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose

Array = NDArray[np.float64]

_LAYERS = (0.008, 0.014, 0.022, math.inf)
"""How far the topmost object is assumed to reach below a heap's highest point, in metres. The
depths are tried in this order."""
_LEAST_LAYER = 12
"""The least number of pixels of a layer that may be an object."""
_REACH = 0.030
"""The largest distance, in metres, by which an object extends beyond its topmost layer."""
_ROOMS = (0.030, 0.015, 0.008)
"""Clearances around an object that is laid on the table, in metres, in the order in which they are
tried."""
_TURNS = 12
"""The number of rotations that are tried for an object that is laid down."""
_GRASPS = 6
"""The number of grasps of a layer that are tried."""


def separating_action(
    inventory: Inventory, planner: PickPlaceParameters, failed_picks: Sequence[PlanarPose] = ()
) -> PickPlaceAction | None:
    """Finds an action that lays the topmost part of a heap on a free part of the table.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick.
        failed_picks: gripper poses at which a grasp failed before; they are avoided.

    Returns:
        The action for the highest of `Inventory.worth_a_try` that can be gripped; None if there
        is none, or no room on the table.
    """
    observation, segmentation = inventory.observation, inventory.segmentation
    resolution = observation.grid.resolution
    failed = failed_pixels(observation.grid, failed_picks)
    strangers = sorted(inventory.worth_a_try, key=lambda item: -item.height)
    for stranger in strangers:
        for layer in topmost_layers(segmentation, stranger):
            grasps = jaw_grasps(segmentation, layer, resolution, planner)
            for grasp in untried(grasps, failed, resolution)[:_GRASPS]:
                found = _free_pose(segmentation, stranger, layer, grasp.pixel, resolution)
                if found is None:
                    continue
                place, rotation = found
                action = make_action(observation, grasp.pixel, grasp.theta, place, rotation)
                return replace(action, aside=True)
    return None


def turning_action(
    inventory: Inventory, planner: PickPlaceParameters, failed_picks: Sequence[PlanarPose] = ()
) -> PickPlaceAction | None:
    """Finds an action that turns over an object, by releasing it at the edge of a block.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick.
        failed_picks: gripper poses at which a grasp failed before; they are avoided.

    Returns:
        The action for the first object that lies upside down and has both a feasible grasp and a
            free edge to tip over; None if there is none.
    """
    segmentation, grid = inventory.segmentation, inventory.observation.grid
    failed = failed_pixels(grid, failed_picks)
    corners = np.array([[0, 0], [grid.rows - 1, grid.cols - 1]])
    low, high = (tuple(corner) for corner in grid.to_world(corners).tolist())
    for region in inventory.reversed_items:
        if inventory.is_tried(region):
            continue
        # Use the centre of the object's volume as its centre of mass.
        weights = segmentation.relief[region.mask]
        points = grid.to_world(region.pixels)
        center = np.average(points, axis=0, weights=weights)
        along = np.linalg.eigh(np.cov((points - center).T))[1][:, 1]
        yaw = math.atan2(along[1], along[0])
        outline = (points - center) @ np.array([[along[0], -along[1]], [along[1], along[0]]])
        others = segmentation.occupied & ~region.mask & ~segmentation.fixture
        pixels = np.argwhere(others)
        around = np.column_stack([grid.to_world(pixels), segmentation.relief[others]])
        ledges = _ledges(segmentation, grid)
        poses = (ledge.turning_pose(outline, center, around, (low, high)) for ledge in ledges)
        turned = next((pose for pose in poses if pose is not None), None)
        if turned is None:
            continue
        grasps = jaw_grasps(segmentation, region, grid.resolution, planner)
        if grasps := untried(grasps, failed, grid.resolution):
            x, y = grid.to_world(grasps[0].pixel).tolist()
            pick = PlanarPose(x, y, grasps[0].theta)
            place = moved_gripper(pick, center, yaw, turned)
            return PickPlaceAction(pick=pick, place=place, aside=True)
    return None


def _ledges(segmentation: Segmentation, grid: PixelGrid) -> list[Ledge]:
    """Returns the blocks over whose edges objects can tip: the smallest rectangle around each
    fixture."""
    labels, count = ndimage.label(segmentation.fixture)
    found = []
    for number in range(1, count + 1):
        corners = grid.to_world(np.argwhere(labels == number))
        corners = corners[ConvexHull(corners).vertices]
        best: tuple[float, Ledge] | None = None
        for side in np.roll(corners, -1, axis=0) - corners:
            yaw = math.atan2(side[1], side[0])
            cos, sin = math.cos(yaw), math.sin(yaw)
            turned = corners @ np.array([[cos, -sin], [sin, cos]])
            low, high = turned.min(axis=0), turned.max(axis=0)
            u, v = ((low + high) / 2).tolist()
            size = (high - low + grid.resolution).tolist()
            if best is None or size[0] * size[1] < best[0]:
                pose = PlanarPose(cos * u - sin * v, sin * u + cos * v, yaw)
                best = size[0] * size[1], Ledge(pose, (size[0], size[1]))
        if best is not None:
            found.append(best[1])
    return found


def topmost_layers(segmentation: Segmentation, region: Region) -> list[Region]:
    """Returns the topmost layers of a region, thinnest first. The last layer is the whole
    region."""
    relief = segmentation.relief
    top = float(np.percentile(relief[region.mask], 99))
    layers = []
    for depth in _LAYERS:
        labels, count = ndimage.label(region.mask & (relief > top - depth), np.ones((3, 3)))
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        for number in np.argsort(-sizes):
            if sizes[number] < _LEAST_LAYER:
                break
            mask = labels == number + 1
            layers.append(Region(mask, float(np.percentile(relief[mask], 90))))
    return layers


def _free_pose(
    segmentation: Segmentation, region: Region, layer: Region, pick: Array, resolution: float
) -> tuple[Array, float] | None:
    """Finds the nearest pose on the table at which an object has enough clearance. The clearances
    `_ROOMS` are tried in order.

    Returns:
        The place (row, col) of the gripped point and the object's rotation in radians; None if
            there is no room.
    """
    within = ndimage.distance_transform_edt(~layer.mask) * resolution < _REACH
    footprint = np.argwhere(region.mask & within) - pick
    occupied = np.pad(segmentation.occupied, 1, constant_values=True)
    distance = ndimage.distance_transform_edt(~occupied)[1:-1, 1:-1] * resolution
    for room in _ROOMS:
        best: tuple[float, Array, float] | None = None
        for angle in np.arange(_TURNS) * math.tau / _TURNS - math.pi + math.tau / _TURNS:
            free = _free_pixels(distance >= room, footprint @ rotation_matrix(float(angle)).T)
            if free is None:
                continue
            away = np.linalg.norm(free - pick, axis=1) * resolution
            # Besides the distance, count the rotation of the wrist, which also takes time.
            index = int(away.argmin())
            cost = float(away[index] + 0.05 * abs(angle))
            if best is None or cost < best[0]:
                best = cost, free[index], float(angle)
        if best is not None:
            return best[1], best[2]
    return None


def _free_pixels(free: NDArray[np.bool_], footprint: Array) -> Array | None:
    """Returns the positions (n, 2) at which all pixels of a footprint (m, 2) are free; None if
    there are none."""
    cells = np.unique(np.rint(footprint).astype(int), axis=0)
    low, high = cells.min(axis=0), cells.max(axis=0)
    kernel = np.zeros(high - low + 1)
    kernel[tuple((cells - low).T)] = 1
    size = tuple(int(n) for n in np.array(free.shape) + kernel.shape)
    blocked = np.fft.irfft2(
        np.fft.rfft2((~free).astype(float), size) * np.conj(np.fft.rfft2(kernel, size)), size
    )
    rows, cols = (int(n) for n in np.array(free.shape) - kernel.shape + 1)
    if rows <= 0 or cols <= 0:
        return None
    corners = np.argwhere(blocked[:rows, :cols] < 0.5)
    return (corners - low).astype(float) if len(corners) else None
