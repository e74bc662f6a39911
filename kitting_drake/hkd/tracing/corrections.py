"""A user's corrections of a trace, read from the file of `--points`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from manifold3d import CrossSection, FillRule
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

_KINDS = ("add", "remove", "sheet")


@dataclass(frozen=True)
class Corrections:
    """The sheet's corners, and polygons to add to the traced region or to remove from it."""

    steps: tuple[tuple[str, NDArray[np.float64]], ...] = ()
    """The polygons, in the order in which they are applied. Each has a kind, `add` or `remove`, and
    points (n, 2) in mm, as on the rulers of `trace.png`."""
    corners: NDArray[np.float64] | None = None
    """The sheet's corners (4, 2) in pixels of the photo, counter-clockwise in the picture. None:
    the corners are found automatically."""

    def settles(self, place: tuple[float, float]) -> bool:
        """Whether the user has checked a place (x, y), in mm: whether a polygon covers it."""
        spot = CrossSection.square((0.1, 0.1), True).translate(place)
        return any(
            not (CrossSection([points], FillRule.EvenOdd) ^ spot).is_empty()
            for _, points in self.steps
        )

    def applied(self, area: CrossSection) -> CrossSection:
        """Returns a region with the polygons added and removed."""
        for kind, points in self.steps:
            polygon = CrossSection([points], FillRule.EvenOdd)
            area = area + polygon if kind == "add" else area - polygon
        return area


def read_corrections(path: Path) -> Corrections:
    """Reads a YAML list of items `add: [[x, y], ...]`, `remove: [[x, y], ...]` and `sheet: [[u, v],
    ...]`.

    Raises:
        UserError: the file is missing, or is not such a list. The message names the item.
    """
    try:
        items = yaml.safe_load(path.read_text())
    except OSError as error:
        raise UserError(f"--points: there is no file {path}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not YAML") from error
    if not isinstance(items, list):
        raise UserError(f"{path} must be a list of items such as 'add: [[10, 20], [30, 20], ...]'")
    steps, corners = [], None
    for number, item in enumerate(items, start=1):
        if not isinstance(item, dict) or len(item) != 1 or next(iter(item)) not in _KINDS:
            raise UserError(f"{path}: item {number} must have one of the keys {', '.join(_KINDS)}")
        ((kind, value),) = item.items()
        points = _points(value, f"{path}: item {number}")
        if kind != "sheet":
            steps.append((kind, points))
        elif len(points) == 4:
            corners = _ordered(points)
        else:
            raise UserError(f"{path}: item {number}: a sheet has 4 corners, not {len(points)}")
    return Corrections(tuple(steps), corners)


def _points(value: object, where: str) -> NDArray[np.float64]:
    try:
        points = np.array(value, float)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise UserError(f"{where} must be a list of at least 3 points [x, y]")
    return points


def _ordered(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orders corners (4, 2) in pixels so that they run counter-clockwise in the picture."""
    away = corners - corners.mean(axis=0)
    return corners[np.argsort(-np.arctan2(away[:, 1], away[:, 0]))]
