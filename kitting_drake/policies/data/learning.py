"""The assumptions that a task allows in training. Imports neither Drake nor torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Learning:
    """Assumptions that a task allows training to make.

    By default there are none, as in the paper (section V-C.1).
    """

    later_picks_possible: bool = False
    """Objects can be picked in any order. Every later pick of a demonstration then also labels its
    earlier observations. True for kitting, false for stacking."""
    curvature: bool = False
    """Objects may be bent in the image to augment pick angles: they come in slightly different
    shapes, and bent ones are picked alike. True for hand tools, false for blocks."""
    reflection: bool = False
    """Mirror images of scenes are valid scenes of the task, and their objects are handled alike.
    True for hand tools of many shapes."""
    many_answers: bool = False
    """The expert's action is one of several equally right ones: objects are symmetric, or places
    are interchangeable. A checkpoint is then chosen by the losses, because errors against the
    expert say little. True for blocks, false for hand tools."""
