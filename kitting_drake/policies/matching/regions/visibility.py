"""Finds the parts of o_t that are seen well enough to pick and place there.

A robot must not reach where no camera looks. It may reach into a small shadow, because a camera
never sees an object from all sides. So the pick itself and most of the area that the jaws sweep
must be seen, and all of this area must be within some camera's view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import moved_pixels
from systems.hand_geometry import FINGERTIP_DEPTH, PAD_LENGTH
from systems.signals import Observation, PixelGrid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MARGIN = 0.010
"""The least distance, in metres, of a pick from the edge of the cameras' views."""
_AROUND = 5
"""The side, in pixels, of the square around a pick. More than half of the square must be seen."""
_LANDING = 0.5
"""At least this share of the area under each finger of the open jaws must be seen."""
_SWEPT = 0.5
"""At least this share of the area between the fingers of the open jaws must be seen."""
_LINES, _DEPTHS, _SWEEPS = 5, 4, 17
"""The numbers of samples along the pads, across a finger, and from finger to finger."""
_INSIDE = 0.9
"""The least share of a placed object that must lie within the workspace."""
_OUT_OF_VIEW = 0.02
"""The largest share of a placed object and its surroundings that may lie outside all views."""
_RING = 3
"""How far the surroundings of a placed object extend from it, in pixels."""
_RING_SEEN = 0.5
"""At least this share of the surroundings of a placed object must be seen."""
_PLACE_SEEN = 0.25
"""At least this share of the area in which a placed object will lie must be seen."""
_RIM_SEEN, _FLOOR_SEEN = 0.85, 0.10
"""If at least the share `_RIM_SEEN` of the surroundings is seen, `_FLOOR_SEEN` of the area is
enough. Seen from the side, a deep cavity's rim hides most of its floor."""
_WHOLE = 0.98
"""The workspace is whole in view if at least this share of it is in some camera's view."""
_BLIND = 0.020
"""The radius that is assumed for an object of unknown outline, in metres."""


@dataclass(frozen=True)
class Visibility:
    """The pixels of an observation that a camera sees, and those in a camera's field of view."""

    seen: Mask
    """(rows, cols) mask of the pixels that some camera sees."""
    in_view: Mask
    """(rows, cols) mask of the pixels in some camera's field of view, whether or not something
    hides them."""
    resolution: float
    """The side of a pixel, in metres."""

    @classmethod
    def of(cls, observation: Observation) -> Visibility:
        """Finds which pixels of an observation are seen."""
        grid: PixelGrid = observation.grid
        return cls(observation.valid, observation.in_view, grid.resolution)

    @property
    def is_whole(self) -> bool:
        """Whether the cameras' fields of view cover the workspace."""
        return bool(self.in_view.mean() >= _WHOLE)

    @property
    def pickable(self) -> Mask:
        """(rows, cols): the pixels that are seen well enough for a pick."""
        if self.seen.all() and self.in_view.all():
            return self.seen
        around = ndimage.uniform_filter(self.seen.astype(np.float32), _AROUND, mode="nearest")
        pickable = self.seen & (around > 0.5)
        if not self.in_view.all():
            inside = ndimage.distance_transform_edt(self.in_view) * self.resolution
            pickable &= inside > _MARGIN
        return pickable

    def picks_are_seen(self, pixels: Array, thetas: Array, open_width: float) -> Mask:
        """Returns, for each of n picks, whether its surroundings and the area that the jaws sweep
        are seen well enough.

        Args:
            pixels: (n, 2) row and column of each pick.
            thetas: (n,) angle of the gripper at each pick, in radians.
            open_width: the opening of the jaws before they close, in metres.
        """
        if self.seen.all() and self.in_view.all():
            return np.ones(len(pixels), bool)
        along = np.stack([np.cos(thetas), np.sin(thetas)], axis=-1)[:, None, None]
        across = np.stack([-np.sin(thetas), np.cos(thetas)], axis=-1)[:, None, None]
        u = np.linspace(-PAD_LENGTH / 2, PAD_LENGTH / 2, _LINES)[:, None, None]
        outwards = open_width / 2 + np.linspace(0, FINGERTIP_DEPTH, _DEPTHS)
        sweep = np.linspace(-open_width / 2, open_width / 2, _SWEEPS)
        good = np.ones(len(pixels), bool)
        parts = ((outwards, _LANDING), (-outwards, _LANDING), (sweep, _SWEPT))
        for offsets, share in parts:
            s = offsets[None, :, None]
            positions = pixels[:, None, None] + (along * u + across * s) / self.resolution
            good &= _at(self.seen, positions).mean(axis=(1, 2)) >= share
            good &= _at(self.in_view, positions).all(axis=(1, 2))
        return good & _at(self.pickable, pixels)

    def place_is_seen(
        self, footprint: Array | None, pick: Array, rotation: float, place: Array
    ) -> bool:
        """Whether the area in which an object will lie and its surroundings are seen well enough.

        Args:
            footprint: (n, 2), the object's pixels before the pick; None if they are unknown.
            pick: (row, col) at which the object is gripped.
            rotation: the rotation of the object from pick to place, in radians.
            place: (row, col) to which the gripped point goes.
        """
        if footprint is None:
            reach = np.arange(-_BLIND, _BLIND + self.resolution, self.resolution) / self.resolution
            disc = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2)
            footprint = pick + disc[np.linalg.norm(disc, axis=1) * self.resolution <= _BLIND]
        there = moved_pixels(footprint, pick, rotation, place)
        rows, cols = self.seen.shape
        within = ((there >= 0) & (there < (rows, cols))).all(axis=1)
        if within.mean() < _INSIDE:
            return False
        if self.seen.all() and self.in_view.all():
            return True
        mask = np.zeros(self.seen.shape, bool)
        mask[tuple(there[within].T)] = True
        mask = ndimage.binary_closing(mask, iterations=2) | mask
        ring = ndimage.binary_dilation(mask, iterations=_RING) & ~mask
        rim, floor = self.seen[ring].mean(), self.seen[mask].mean()
        is_seen = (rim >= _RING_SEEN and floor >= _PLACE_SEEN) or (
            rim >= _RIM_SEEN and floor >= _FLOOR_SEEN
        )
        return bool(is_seen and (~self.in_view[mask | ring]).mean() <= _OUT_OF_VIEW)


def _at(mask: Mask, positions: Array) -> Mask:
    """Returns the values of a mask at positions (..., 2) in pixels; True outside the image."""
    row, col = np.moveaxis(np.rint(positions).astype(int), -1, 0)
    rows, cols = mask.shape
    outside = (row < 0) | (row >= rows) | (col < 0) | (col >= cols)
    return mask[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)] | outside
