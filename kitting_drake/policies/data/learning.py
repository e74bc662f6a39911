"""The assumptions that a task allows in training; no Drake and no torch here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Learning:
    """Assumptions that training may make: a task says which of them hold for its scenes.

    By default none does, which is the paper's own way of training (section V-C.1).
    """

    later_picks_possible: bool = False
    """Objects that the expert picked later could have been picked at once, from where they lay:
    every later pick is then a label of an observation too. True for kitting, false for stacking."""
    curvature: bool = False
    """Objects may be bent in the image to augment pick angles: objects of the task come in slightly
    different shapes and bent ones are picked alike. True for hand tools, false for blocks."""
    reflection: bool = False
    """Mirror images of scenes are scenes of the task as well, and their objects are handled alike.
    True for hand tools of many shapes."""
    many_answers: bool = False
    """The expert's action is one of several that are equally right: objects are symmetric, or
    places may be exchanged. Errors against it then say little, and a checkpoint is chosen by the
    losses. True for blocks, false for hand tools."""
