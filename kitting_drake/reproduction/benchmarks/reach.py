"""Measures where an arm reaches in a workspace, and finds the best place for its base (`benchmark
reach`)."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kitting_drake.real_camera.robots.bench_robot import BenchRobot
from kitting_drake.scenario.robots import FOOT
from systems.arm_kinematics import ArmBase
from systems.arm_reach_map import MARGIN, YAWS, ReachMap
from systems.signals import PixelGrid

_LEVELS = 4
"""The number of heights at which the reach is measured."""
_LOWEST = 0.02
"""The lowest height at which the reach is measured, above the table, in m."""
_SPACING, _COARSE = 0.025, 0.10
"""The spacing of the map's points, and of the points for the search, in m."""
_AROUND = 0.8
"""Bases are tried up to this distance from the workspace, along x and along y, in m."""
_STEP, _FINER = 0.10, 0.05
"""The spacing of the bases that are tried, in m: in a first search, and in a second search around
the best bases of the first search."""
_TURNS = (0.0, -45.0, 45.0, 180.0)
"""The yaws of the base to try, relative to the yaw at which it faces the workspace, in degrees."""


@dataclass(frozen=True)
class _Best:
    share: float
    base: ArmBase


def measure_reach(robot: BenchRobot, grid: PixelGrid, console: Console) -> dict[str, Any]:
    """Measures the reach from a base, and searches for a better base.

    Args:
        robot: the arm with its base; the search keeps the base's height.
        grid: the workspace.
        console: the console for the progress.

    Returns:
        The content of `reach.json`, in m and degrees. A share, from 0 to 1, is the fraction of the
        hand's positions and yaws that the arm reaches.
    """
    heights = np.linspace(grid.z_min + _LOWEST, grid.z_max, _LEVELS)
    reach = ReachMap(robot.limits, heights - robot.base.z)
    x, y = _points(grid, _SPACING)
    shares = _shares(reach, robot.base, x, y)
    tried, best = _search(reach, robot.base, grid, console)
    return {
        "model": robot.model,
        "margin_rad": MARGIN,
        "yaws": YAWS,
        "base": _base_record(robot.base),
        "share": float(shares.mean()),
        "heights": heights.tolist(),
        "share_by_height": shares.mean(axis=(0, 1)).tolist(),
        "x": x.tolist(),
        "y": y.tolist(),
        "shares": np.round(np.moveaxis(shares, -1, 0), 4).tolist(),
        "best_base": _base_record(best.base),
        "best_share": best.share,
        "tried_bases": tried,
    }


def _base_record(base: ArmBase) -> dict[str, Any]:
    return {"base": [base.x, base.y, base.z], "yaw_deg": round(math.degrees(base.yaw), 6)}


def _points(grid: PixelGrid, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Divides the grid into cells of about the given size; returns the x and the y of their
    middles."""

    def middles(low: float, high: float) -> NDArray[np.float64]:
        count = max(round((high - low) / spacing), 1)
        return low + (np.arange(count) + 0.5) * (high - low) / count

    return middles(grid.x_min, grid.x_max), middles(grid.y_min, grid.y_max)


def _shares(
    reach: ReachMap, base: ArmBase, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns, at each point (x, y, height), the share of the hand's yaws that the arm reaches."""
    points = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    return reach.shares(base, points.reshape(-1, 2)).reshape(len(x), len(y), -1)


def _search(
    reach: ReachMap, given: ArmBase, grid: PixelGrid, console: Console
) -> tuple[list[list[float]], _Best]:
    """Searches for the best base.

    Returns:
        A list (x, y, yaw in degrees, share of reachable poses) for each base that was tried; and
        the best base.
    """
    coarse, fine = _points(grid, _COARSE), _points(grid, _SPACING)
    tried: list[list[float]] = []

    def score(base: ArmBase, points: tuple[NDArray[np.float64], NDArray[np.float64]]) -> float:
        share = float(_shares(reach, base, *points).mean())
        tried.append([base.x, base.y, round(math.degrees(base.yaw), 6), share])
        return share

    bases = _bases(given, grid)
    places = track(bases, "searching", console=console, transient=True, disable=console.quiet)
    found = [_Best(score(base, coarse), base) for base in places]
    # Among equally good bases, prefer the one farthest from the workspace: its joints move less.
    middle = (grid.x_min + grid.x_max) / 2, (grid.y_min + grid.y_max) / 2

    def order(it: _Best) -> tuple[float, float]:
        away = math.hypot(it.base.x - middle[0], it.base.y - middle[1])
        return round(it.share, 3), away

    found.sort(key=order, reverse=True)
    around = [
        ArmBase(first.base.x + dx, first.base.y + dy, given.z, first.base.yaw)
        for first in found[:3]
        for dx in (-_FINER, 0.0, _FINER)
        for dy in (-_FINER, 0.0, _FINER)
    ]
    candidates = [base for base in dict.fromkeys([*around, given]) if _is_outside(base, grid)]
    exact = [_Best(score(base, fine), base) for base in candidates]
    return tried, max(exact, key=order)


def _is_outside(base: ArmBase, grid: PixelGrid) -> bool:
    """Whether the arm's foot stands outside the workspace."""
    dx = max(grid.x_min - base.x, base.x - grid.x_max, 0.0)
    dy = max(grid.y_min - base.y, base.y - grid.y_max, 0.0)
    return math.hypot(dx, dy) >= FOOT


def _bases(given: ArmBase, grid: PixelGrid) -> list[ArmBase]:
    """Returns the bases to try around the workspace, at multiples of `_STEP`."""

    def around(low: float, high: float) -> range:
        return range(math.ceil((low - _AROUND) / _STEP), math.floor((high + _AROUND) / _STEP) + 1)

    middle = (grid.x_min + grid.x_max) / 2, (grid.y_min + grid.y_max) / 2
    found = []
    for i in around(grid.x_min, grid.x_max):
        for j in around(grid.y_min, grid.y_max):
            x, y = round(i * _STEP, 6), round(j * _STEP, 6)
            facing = 45 * round(math.degrees(math.atan2(middle[1] - y, middle[0] - x)) / 45)
            turned = (math.remainder(facing + turn, 360.0) for turn in _TURNS)
            found += [ArmBase(x, y, given.z, math.radians(yaw)) for yaw in turned]
    return [base for base in found if _is_outside(base, grid)]


def reach_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the reach of the given base and of the best base. For the given base it also
    has the reach at each height."""
    table = Table(title=f"reach of a {measured['model']}", title_justify="left")
    for heading in ("base x, y, z, m", "yaw, deg", "workspace"):
        table.add_column(heading, justify="right")
    for height in measured["heights"]:
        table.add_column(f"z {height:.2f} m", justify="right")
    by_height = [f"{100 * share:.1f} %" for share in measured["share_by_height"]]
    for record, share, rest in (
        (measured["base"], measured["share"], by_height),
        (measured["best_base"], measured["best_share"], ["best base found"]),
    ):
        x, y, z = record["base"]
        place = f"{x:g}, {y:g}, {z:g}"
        table.add_row(place, f"{record['yaw_deg']:g}", f"{100 * share:.1f} %", *rest)
    return table


def draw_reach(measured: dict[str, Any]) -> bytes:
    """Draws the reach at each height, and the reach from all bases that were tried, as a PNG."""
    figure = Figure(figsize=(15, 6.2), layout="constrained", dpi=110)
    mosaic: list[list[Any]] = [[0, 1, "bases"], [2, 3, "bases"]]
    axes = figure.subplot_mosaic(mosaic, width_ratios=[1, 1, 1.9])
    shares = np.array(measured["shares"])
    picture = None
    for level, height in enumerate(measured["heights"]):
        picture = _draw_level(axes[level], measured, shares[level])
        title = f"z {height:.2f} m: {100 * measured['share_by_height'][level]:.1f} %"
        axes[level].set_title(title, loc="left", fontsize=10)
    _draw_bases(axes["bases"], measured)
    figure.colorbar(picture, ax=list(axes.values()), label="share", shrink=0.7)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _edges(middles: list[float]) -> tuple[float, float]:
    half = (middles[1] - middles[0]) / 2 if len(middles) > 1 else _SPACING / 2
    return middles[0] - half, middles[-1] + half


def _draw_level(axes: Axes, measured: dict[str, Any], shares: NDArray[np.float64]) -> Any:
    (x_min, x_max), (y_min, y_max) = _edges(measured["x"]), _edges(measured["y"])
    picture = axes.imshow(
        shares,
        cmap=matplotlib.colormaps["viridis"],
        vmin=0.0,
        vmax=1.0,
        origin="lower",
        extent=(y_min, y_max, x_min, x_max),
    )
    _mark(axes, measured["base"], "#e4572e")
    axes.autoscale()
    axes.margins(0.08)
    axes.set(xlabel="y, m", ylabel="x, m", aspect="equal")
    return picture


def _draw_bases(axes: Axes, measured: dict[str, Any]) -> None:
    best: dict[tuple[float, float], float] = {}
    for x, y, _, share in measured["tried_bases"]:
        best[x, y] = max(best.get((x, y), 0.0), share)
    places = np.array(list(best))
    axes.scatter(
        places[:, 1],
        places[:, 0],
        c=list(best.values()),
        s=46,
        marker="s",
        cmap=matplotlib.colormaps["viridis"],
        vmin=0.0,
        vmax=1.0,
    )
    (x_min, x_max), (y_min, y_max) = _edges(measured["x"]), _edges(measured["y"])
    corners = [(y_min, x_min), (y_max, x_min), (y_max, x_max), (y_min, x_max), (y_min, x_min)]
    axes.plot(*zip(*corners, strict=True), color="0.3", lw=1)
    middle = ((x_min + x_max) / 2, (y_min + y_max) / 2)
    axes.text(middle[1], middle[0], "workspace", ha="center", va="center", fontsize=9)
    _mark(axes, measured["base"], "#e4572e", f"given: {100 * measured['share']:.1f} %")
    _mark(axes, measured["best_base"], "#1b998b", f"best: {100 * measured['best_share']:.1f} %")
    axes.set(xlabel="y, m", ylabel="x, m", aspect="equal")
    axes.set_title("reach of the workspace by the place of the base", loc="left", fontsize=10)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=8)


def _mark(axes: Axes, record: dict[str, Any], colour: str, label: str = "") -> None:
    """Draws an arrow at a base, along the base's x axis."""
    (x, y, _), yaw = record["base"], math.radians(record["yaw_deg"])
    axes.plot([y], [x], "o", color=colour, ms=7, label=label or None)
    tip = (y + 0.1 * math.sin(yaw), x + 0.1 * math.cos(yaw))
    axes.annotate("", tip, (y, x), arrowprops={"arrowstyle": "->", "color": colour, "lw": 2})
