"""How different two tools are in shape, whatever their size."""

import numpy as np
from scipy.spatial import cKDTree

from kitting_drake.hkd.tools.tool import Tool

# Both tools are scaled to this length, in the middle of the dataset's range.
REFERENCE_LENGTH = 0.175


def mean_surface_distance(
    tool_a: Tool, tool_b: Tool, count: int = 4000, dense: int = 100_000
) -> float:
    """The symmetric mean distance of two surfaces, in metres, the tools scaled to one length.

    The tools are aligned by their frames T. The mean over `count` points, sampled by area on one
    surface, of the distance to the nearest of `dense` points on the other, averaged over both ways.
    """

    def points(tool: Tool, number: int, seed: int) -> np.ndarray:
        return tool.surface_points(number, seed) * (REFERENCE_LENGTH / tool.length)

    def one_way(source: Tool, target: Tool) -> float:
        distance, _ = cKDTree(points(target, dense, 1)).query(points(source, count, 0))
        return float(np.mean(distance))

    return 0.5 * (one_way(tool_a, tool_b) + one_way(tool_b, tool_a))
