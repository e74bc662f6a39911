"""Types of the values that flow between the systems of the kitting cell.

This module does not need pydrake, so that policies can be trained without Drake.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class PixelGrid:
    """The orthographic pixel grid over the workspace. Only this class converts pixels to metres.

    Row `i` runs along world +x and column `j` along world +y. Shown with row 0 on top, an image is
    the workspace seen from above, not mirrored: a counter-clockwise rotation about +z is a
    counter-clockwise rotation of the picture. Whole numbers are pixel *centres*: that of pixel
    (0, 0) is at `x_min + resolution/2, y_min + resolution/2`.

    The defaults are the workspace of Ravens and of the paper's simulation (section IV-B.4).
    """

    x_min: float = 0.25
    """Lower edge of the workspace along world x, in metres."""
    y_min: float = -0.5
    """Lower edge of the workspace along world y, in metres."""
    resolution: float = 0.003125
    """Side of a pixel, in metres."""
    rows: int = 160
    """Number of pixels along world x."""
    cols: int = 320
    """Number of pixels along world y."""
    z_min: float = 0.0
    """World z of the height zero in heightmaps, in metres."""
    z_max: float = 0.28
    """Points above this world z, in metres, are dropped."""

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or self.resolution <= 0:
            raise ValueError(
                "rows, cols and resolution of a pixel grid must be positive, not "
                f"{self.rows}, {self.cols} and {self.resolution:g}"
            )
        if self.z_max <= self.z_min:
            raise ValueError(
                f"z_max of a pixel grid is {self.z_max:g}, but must be above z_min, which is "
                f"{self.z_min:g}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of pixels, (rows, cols)."""
        return self.rows, self.cols

    @property
    def x_max(self) -> float:
        """Upper edge of the workspace along world x, in metres."""
        return self.x_min + self.rows * self.resolution

    @property
    def y_max(self) -> float:
        """Upper edge of the workspace along world y, in metres."""
        return self.y_min + self.cols * self.resolution

    def to_pixel(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Continuous (row, col) of world points (..., 2) in metres."""
        offset = np.asarray(xy, dtype=float) - (self.x_min, self.y_min)
        return offset / self.resolution - 0.5

    def to_world(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """World (x, y) in metres of continuous pixel coordinates (row, col), (..., 2)."""
        offset = (np.asarray(pixel, dtype=float) + 0.5) * self.resolution
        return offset + np.array([self.x_min, self.y_min])

    def contains(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether each of the world points (..., 2) is on the grid."""
        row, col = np.moveaxis(self.to_pixel(xy), -1, 0)
        inside = (row >= -0.5) & (row < self.rows - 0.5) & (col >= -0.5) & (col < self.cols - 0.5)
        return np.asarray(inside)


@dataclass(frozen=True)
class Observation:
    """o_t of the paper (section III-A): the workspace seen orthographically from above."""

    image: NDArray[np.float32] = field(default_factory=lambda: np.zeros((4, 160, 320), np.float32))
    """(4, rows, cols): red, green, blue in [0, 1], and height above `grid.z_min` in metres. Unseen
    pixels are zero in all four channels."""
    grid: PixelGrid = field(default_factory=PixelGrid)
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(rows, cols) mask of the pixels that some camera sees. Default: the pixels with a non-zero
    channel."""
    in_view: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(rows, cols) mask of the pixels in some camera's field of view, whether or not something
    hides them. Default: all pixels."""
    edge_height: NDArray[np.float32] = None  # type: ignore[assignment]
    """(rows, cols) heights of the edges of surfaces, in metres above `grid.z_min` (see
    `surface_edges`); zero where there is none. They belong to `image`: replace both together.
    Default: no edges."""
    table: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The table's plane, which was subtracted from the heights: at (row, col) it lay
    `table @ (row, col, 1)` metres above `grid.z_min`."""
    history: tuple[Attempt, ...] = ()
    """The earlier actions of the episode, oldest first; empty if they are not recorded."""

    def __post_init__(self) -> None:
        if self.valid is None:
            object.__setattr__(self, "valid", self.image.any(axis=0))
        if self.in_view is None:
            object.__setattr__(self, "in_view", np.ones(self.image.shape[1:], bool))
        if self.edge_height is None:
            edges = np.zeros(self.image.shape[1:], np.float32)
            object.__setattr__(self, "edge_height", edges)

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(3, rows, cols) red, green and blue, in [0, 1]."""
        return self.image[:3]

    @property
    def height(self) -> NDArray[np.float32]:
        """(rows, cols) heights in metres above `grid.z_min`."""
        return self.image[3]

    @cached_property
    def filled_height(self) -> NDArray[np.float32]:
        """(rows, cols): `height` with unseen pixels filled in (`fill_unseen`)."""
        return fill_unseen(self.height, self.valid, self.in_view)

    @cached_property
    def outline_height(self) -> NDArray[np.float32]:
        """(rows, cols): as `filled_height`, but each surface reaches to its edge. In `height` it
        ends half the distance of two samples before, on the side that faces away from an oblique
        camera."""
        edges = self.edge_height > 0
        if not edges.any():
            return self.filled_height
        filled = fill_unseen(self.height, self.valid, self.in_view, edges)
        return np.maximum(filled, self.edge_height)

    @cached_property
    def outline_valid(self) -> NDArray[np.bool_]:
        """(rows, cols) mask of the pixels that are `valid` or have an edge."""
        return np.asarray(self.valid | (self.edge_height > 0))


_FILL_REACH = 25
"""A narrow hole is filled from its border at most this far inwards, in pixels."""
_SHADOW_REACH = 75
"""A shadow is filled from pixels at most this far away, in pixels."""
_SHADOW = np.ones((3, 3), bool)
"""A hole into which this square fits may be the shadow of an object. A narrower hole is a gap
between points that a camera measured."""
_HIDDEN_BELOW = 0.005
"""A pixel beside a shadow shows the hidden surface if it is at most this much, in metres, above the
lowest such pixel. Higher pixels may belong to the object that casts the shadow."""


def fill_unseen(
    height: NDArray[np.float32],
    valid: NDArray[np.bool_],
    in_view: NDArray[np.bool_] | None = None,
    edges: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Fills the heights of unseen pixels.

    A hidden surface is lower than the surface that hides it. So a wide hole is filled from the
    lowest seen pixels around it: each of its pixels gets the height of the nearest of these. So is
    a hole beside an edge, because the edge hides it. Any other narrow hole is filled from its
    border inwards, each pixel with the height of its lowest neighbour. Pixels outside all views, or
    deep in a large hole, get the table's height, zero, because nothing is known about them.

    Args:
        height: (rows, cols), in metres above the table.
        valid: (rows, cols) mask of the pixels with a measured height.
        in_view: (rows, cols) mask of the pixels in a camera's field of view; None for all pixels.
        edges: (rows, cols) mask of the known edges; None if there are none.
    """
    if valid.all() or not valid.any():
        return height
    # Import SciPy lazily.
    from scipy import ndimage

    filled = np.where(valid, height, np.inf).astype(np.float32)
    holes = ~valid if in_view is None else ~valid & in_view
    shadows = ndimage.binary_opening(holes, _SHADOW)
    if edges is not None:
        labels, count = ndimage.label(holes, np.ones((3, 3), bool))
        is_shadow = np.zeros(count + 1, bool)
        is_shadow[labels[ndimage.binary_dilation(edges, np.ones((3, 3), bool))]] = True
        shadows |= is_shadow[labels] & holes
    _fill_shadows(filled, shadows)
    for _ in range(_FILL_REACH):
        missing = holes & ~np.isfinite(filled)
        if not missing.any():
            break
        lowest = ndimage.minimum_filter(filled, size=3, mode="nearest")
        filled = np.where(missing, lowest, filled)
    return np.where(np.isfinite(filled), filled, np.float32(0))


def _fill_shadows(filled: NDArray[np.float32], shadows: NDArray[np.bool_]) -> None:
    """Fills wide holes in place.

    Args:
        filled: (rows, cols) heights in metres, infinite where unknown.
        shadows: (rows, cols) mask of the wide holes.
    """
    from scipy import ndimage

    seen = filled.copy()
    labels, _ = ndimage.label(shadows, np.ones((3, 3), bool))
    for label, place in enumerate(ndimage.find_objects(labels), 1):
        # Look two pixels beyond a shadow, because narrow gaps may surround it.
        rows, cols = (slice(max(part.start - 2, 0), part.stop + 2) for part in place)
        shadow, around = labels[rows, cols] == label, seen[rows, cols]
        border = ndimage.binary_dilation(shadow, _SHADOW, iterations=2) & np.isfinite(around)
        if border.any():
            low = border & (around <= around[border].min() + _HIDDEN_BELOW)
            away, nearest = ndimage.distance_transform_edt(~low, return_indices=True)
            heights = np.where(away <= _SHADOW_REACH, around[tuple(nearest)], np.float32(0))
            filled[rows, cols][shadow] = heights[shadow]


@dataclass(frozen=True)
class PlanarPose:
    """A pose of the gripper in SE(2), pointing straight down.

    Theta rotates the hand about world +z, counter-clockwise; at zero the jaws close along world y.
    """

    x: float = 0.0
    """World x of the point midway between the fingertips, in metres."""
    y: float = 0.0
    """World y of the point midway between the fingertips, in metres."""
    theta: float = 0.0
    """Rotation about world +z, in radians."""

    def as_array(self) -> NDArray[np.float64]:
        """The pose as an array (x, y, theta), in metres and radians."""
        return np.array([self.x, self.y, self.theta])


@dataclass(frozen=True)
class SurfaceHeights:
    """Heights of surfaces that limit the motion of a pick and place, in metres in the world.

    `systems.surface_heights.read_surface_heights` reads them off o_t, for every policy.
    """

    pick_top: float = 0.0
    """Height of the object's top at the pick."""
    support: float = 0.0
    """Height of the surface on which the object stands."""
    place_rim: float = 0.0
    """Height of the highest surface around the place, for example the rim of a cavity."""
    place_floor: float = 0.0
    """Height of the lowest surface at the place, on which the object will stand."""
    near_pick: float = 0.0
    """Height of the highest surface below the open jaws at the pick."""
    below_palm: float = -math.inf
    """Height of the highest surface below the palm at the pick, or nearly the highest if o_t has
    noise; minus infinity if unknown."""
    near_place: float = 0.0
    """Height of the highest surface below the held object at the place."""
    highest: float = 0.0
    """Height of the highest surface in the workspace."""
    around_pick: float = math.inf
    """Height of the highest surface below an arm's wrist at the pick; infinite if unknown.
    `around_place` is that at the place."""
    around_place: float = math.inf
    table: float = 0.0
    """Height of the table. The hand never goes below it."""
    doubt: float = 0.0
    """The uncertainty of differences between these heights; zero if o_t has no noise or tilt."""
    width: float = math.inf
    """How wide the jaws must open to clear the object at the pick; infinite if unknown."""


STOP_REASONS = {
    "done": "nothing is left to do",
    "nothing fits": "objects and free cavities are left, but none fit each other",
    "no kit seen": "no kit is seen",
    "not seen": "too little is seen to pick, to place, or to know that nothing is left to do",
    "not sure": "no pick and place is likely enough to succeed",
    "gave up": "the remaining objects could not be placed",
    "actions spent": "no actions are left",
}
"""Reasons why no more actions follow, each with a sentence for people."""


@dataclass(frozen=True)
class PickPlaceAction:
    """A pick and a place: a_pick and a_place of the paper (section III-A), both in SE(2).

    The held object rotates by `place.theta - pick.theta`. Adding pi to both angles gives the same
    action, because the jaws are symmetric.
    """

    pick: PlanarPose = field(default_factory=PlanarPose)
    place: PlanarPose = field(default_factory=PlanarPose)
    stop: bool = False
    """Whether the policy stops. The poses are then ignored."""
    reason: str = ""
    """The reason for a stop, a key of `STOP_REASONS`; empty if unknown."""
    press: bool = False
    """Whether the hand only pushes down at the pick with closed jaws. The place is then ignored."""
    aside: bool = False
    """Whether the object is laid on a free part of the table instead of moved to its goal."""
    middle: tuple[float, float] | None = None
    """World (x, y), in metres, of the middle of the picked object as the policy sees it; None if
    unknown. It tells objects apart in the `history`, wherever they are gripped."""
    left_over: LeftOver | None = None
    """The objects and cavities that a policy still sees when it stops; None if it does not report
    them."""
    heights: SurfaceHeights | None = None
    """Heights of the surfaces around pick and place. If None, the planner reads them off o_t."""
    spread: tuple[float, float, float] | None = None
    """Variances xx, xy and yy of the visible points of the picked object about `middle`, in m^2 in
    the world; None if unknown. They tell roughly what the object covers after it was placed."""

    def __post_init__(self) -> None:
        if self.spread is not None:
            xx, xy, yy = self.spread
            if not (xx > 0 and xx * yy > xy**2):
                raise ValueError(
                    f"spread must be the variances of a positive definite matrix, not {self.spread}"
                )

    @property
    def poses(self) -> dict[str, PlanarPose]:
        """The poses that this action uses, by name. A stop uses none, a press only the pick."""
        if self.stop:
            return {}
        return {"pick": self.pick} if self.press else {"pick": self.pick, "place": self.place}


@dataclass(frozen=True)
class LeftOver:
    """The objects that are not placed, and the cavities that are not filled, when a policy
    stops."""

    objects: tuple[tuple[float, float], ...] = ()
    """World (x, y) of each object's middle, in metres."""
    cavities: tuple[tuple[float, float], ...] = ()
    """World (x, y) of each cavity's middle, in metres."""


OUTCOMES = ("placed", "missed", "dropped", "pressed", "stopped", "set down", "unreachable")
"""The outcomes of an action:

- placed: the object was let go at its place, or lost there in a search.
- missed: nothing was grasped.
- dropped: the object was lost on the way.
- pressed: the object was pressed down.
- stopped: a contact force above the limit ended the action.
- set down: the object was set down at the pick, because it would have turned between the pads.
- unreachable: the robot did not move, because it cannot reach the poses.
"""


@dataclass(frozen=True)
class Attempt:
    """An earlier action and its outcome, as far as the robot's own sensors show it."""

    action: PickPlaceAction
    """The action, without heights."""
    outcome: str
    """The outcome of the action, a word of `OUTCOMES`."""
    peak_force: float = 0.0
    """The largest contact force on the hand, in N, without the weight of the held object, as a mean
    over 1/64 s. It may be below the limit although the action was stopped."""
    balance: tuple[float, float] | None = None
    """World (x, y), in metres, of the object's centre of mass; None unless the outcome is "set
    down". It is estimated from the moment on the wrist, which shows only the position along the
    pads."""
    top: float | None = None
    """World height, in metres, that the object's top should have at the place if it stands on the
    floor there; None unless the outcome is "placed"."""
    floor: float | None = None
    """World height, in metres, of the surface at the place before the action; None for a press, and
    if the object was set down where it lay."""


def wrap_to_pi(angle: float) -> float:
    """The equivalent angle in [-pi, pi], in radians."""
    return math.remainder(angle, math.tau)
