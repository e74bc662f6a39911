"""The values that travel on the wires of the kitting cell.

Plain data: no pydrake here, so that policies can be trained where Drake is not installed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class PixelGrid:
    """The orthographic pixel grid over the workspace; nothing else converts pixels to metres.

    Row `i` runs along world +x and column `j` along world +y, so that an image shown with row 0 on
    top is the workspace seen from above, not mirrored: a counter-clockwise turn about +z is a
    counter-clockwise turn of the picture. Whole numbers are pixel *centres*: pixel (0, 0) covers
    half a pixel around its centre at `x_min + resolution/2, y_min + resolution/2`.

    The defaults are the workspace of Ravens and of the paper's simulation (section IV-B.4).
    """

    x_min: float = 0.25
    """Lower edge of the workspace along world x, in metres."""
    y_min: float = -0.5
    """Lower edge of the workspace along world y, in metres."""
    resolution: float = 0.003125
    """Side of a pixel, in metres."""
    rows: int = 160
    """Pixels along x."""
    cols: int = 320
    """Pixels along y."""
    z_min: float = 0.0
    """Height that reads as zero, in metres above the world origin."""
    z_max: float = 0.28
    """Points above this height are left out of the heightmap, in metres."""

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or self.resolution <= 0:
            raise ValueError("a pixel grid needs at least one pixel of positive size")
        if self.z_max <= self.z_min:
            raise ValueError("a pixel grid needs z_max above z_min")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
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
        """World (x, y) in metres of continuous (row, col) coordinates (..., 2)."""
        offset = (np.asarray(pixel, dtype=float) + 0.5) * self.resolution
        return offset + np.array([self.x_min, self.y_min])

    def contains(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Which of the world points (..., 2) fall on the grid."""
        row, col = np.moveaxis(self.to_pixel(xy), -1, 0)
        inside = (row >= -0.5) & (row < self.rows - 0.5) & (col >= -0.5) & (col < self.cols - 0.5)
        return np.asarray(inside)


@dataclass(frozen=True)
class Observation:
    """o_t of the paper (section III-A): the workspace seen orthographically from above."""

    image: NDArray[np.float32] = field(default_factory=lambda: np.zeros((4, 160, 320), np.float32))
    """(4, rows, cols): red, green, blue in [0, 1], and height above `grid.z_min` in metres.
    A pixel that no camera sees is zero in all four."""
    grid: PixelGrid = field(default_factory=PixelGrid)
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(rows, cols): the pixels that some camera sees. Where it is not given, those that are not
    zero in all four."""

    def __post_init__(self) -> None:
        if self.valid is None:
            object.__setattr__(self, "valid", self.image.any(axis=0))

    @property
    def rgb(self) -> NDArray[np.float32]:
        """(3, rows, cols), in [0, 1]."""
        return self.image[:3]

    @property
    def height(self) -> NDArray[np.float32]:
        """(rows, cols), metres above `grid.z_min`."""
        return self.image[3]


def fill_unseen(height: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Heights with the pixels that no camera saw filled in from around them.

    What is hidden is hidden by something higher: a hole takes the lowest of its neighbours, from
    its border inwards.

    Args:
        height: (rows, cols).
        valid: (rows, cols), where it was seen.
    """
    if valid.all() or not valid.any():
        return height
    # Import SciPy lazily.
    from scipy import ndimage

    filled = np.where(valid, height, np.inf).astype(np.float32)
    missing = ~valid
    for _ in range(max(height.shape)):
        lowest = ndimage.minimum_filter(filled, size=3, mode="nearest")
        filled = np.where(missing, lowest, filled)
        missing = ~np.isfinite(filled)
        if not missing.any():
            break
    return filled


@dataclass(frozen=True)
class PlanarPose:
    """A pose of the gripper in SE(2), pointing straight down.

    Theta turns the hand about world +z, counter-clockwise; at zero the jaws close along world y.
    """

    x: float = 0.0
    """World x of the tool centre point, in metres."""
    y: float = 0.0
    """World y of the tool centre point, in metres."""
    theta: float = 0.0
    """Radians."""

    def as_array(self) -> NDArray[np.float64]:
        """(x, y, theta)."""
        return np.array([self.x, self.y, self.theta])


@dataclass(frozen=True)
class SurfaceHeights:
    """The heights that a motion between pick and place must respect, in metres in the world.

    `systems.surface_heights.read_surface_heights` reads them off o_t, for every policy.
    """

    pick_top: float = 0.0
    """The top of what lies under the pick."""
    support: float = 0.0
    """The top of what that stands on."""
    place_rim: float = 0.0
    """The highest surface around the place: the rim of a cavity, if there is one."""
    place_floor: float = 0.0
    """The lowest surface at the place: on it an object there will stand."""
    near_pick: float = 0.0
    """The highest surface that open jaws over the pick are above."""
    near_place: float = 0.0
    """The highest surface that an object over its place is above."""
    highest: float = 0.0
    """The highest surface of the workspace."""
    table: float = 0.0
    """The table, below which nothing goes."""
    doubt: float = 0.0
    """How far these heights may be off each other; zero where o_t has neither noise nor tilt."""


@dataclass(frozen=True)
class PickPlaceAction:
    """One pick and one place: a_pick and a_place of the paper (section III-A), both in SE(2).

    The held object turns by `place.theta - pick.theta`. Turning both by pi is the same action, as
    the jaws are alike.
    """

    pick: PlanarPose = field(default_factory=PlanarPose)
    place: PlanarPose = field(default_factory=PlanarPose)
    stop: bool = False
    """True: there is nothing left to do, and the poses mean nothing."""
    press: bool = False
    """True: push down at the pick with closed jaws, and nothing else; the place means nothing."""
    heights: SurfaceHeights | None = None
    """None: the planner reads them off its own o_t."""

    @property
    def poses(self) -> dict[str, PlanarPose]:
        """Those that mean something, by their names."""
        if self.stop:
            return {}
        return {"pick": self.pick} if self.press else {"pick": self.pick, "place": self.place}


def wrap_to_pi(angle: float) -> float:
    """The same angle in [-pi, pi], in radians."""
    return math.remainder(angle, math.tau)
