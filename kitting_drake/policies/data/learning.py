"""What training may assume about a task. This module imports neither Drake nor torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Learning:
    """What training may assume about a task.

    By default it assumes nothing, as in the paper (section V-C.1).
    """

    later_picks_possible: bool = False
    """Whether objects can be picked in any order. Every later pick of a demonstration then also
    labels the demonstration's earlier observations. True for kitting, false for stacking."""
    curvature: bool = False
    """Whether objects may be bent in the image, as data augmentation for pick angles. This requires
    that the task's objects differ slightly in shape, and that a bent object is picked in the same
    way. True for hand tools, false for blocks."""
    reflection: bool = False
    """Whether the mirror image of a scene is a valid scene of the task, in which the mirrored
    action is right. True for hand tools of many shapes."""
    many_answers: bool = False
    """Whether several actions are equally right, because objects are symmetric or places are
    interchangeable. Deviations from the expert's action then say little, so a checkpoint is chosen
    by its losses. True for blocks, false for hand tools."""
