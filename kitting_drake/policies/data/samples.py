"""Training samples: labelled observations of demonstrations."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from kitting_drake.policies.data.demonstrations import Demonstration
from kitting_drake.policies.data.images import Image, LabelledImage, Pictured
from kitting_drake.policies.data.recorded import FinalObservation
from systems.signals import Observation, PickPlaceAction, PixelGrid, fill_unseen


@dataclass(frozen=True)
class HeightsOnly:
    """A recorded observation, prepared as the input of networks that see only heights."""

    recorded: Pictured

    @property
    def image(self) -> Image:
        """The image (4, rows, cols), with black colours and with unseen heights filled in. It is
        computed at each access."""
        image = self.recorded.image
        image[3] = fill_unseen(image[3], np.any(image, axis=0))
        image[:3] = 0
        return image


def observed(image: Image, grid: PixelGrid) -> Observation:
    """Makes an observation from a recorded image.

    Args:
        image: (4, rows, cols). If all colours are black, all pixels count as seen. Unseen heights
            must then have been filled in.
        grid: the pixel grid of the image.
    """
    valid = None if image[:3].any() else np.ones(image.shape[1:], bool)
    return Observation(image, grid, valid)  # type: ignore[arg-type]


@dataclass(frozen=True)
class ObservedScene:
    """One observation and the actions that the expert may take next."""

    recorded: Pictured
    actions: tuple[PickPlaceAction, ...]
    """The actions that the expert may take next. The action that was taken comes first."""
    grid: PixelGrid

    @property
    def observation(self) -> Observation:
        """The observation; computed at each access."""
        return observed(self.recorded.image, self.grid)

    @property
    def targets(self) -> tuple[LabelledImage, ...]:
        """A labelled image for each action. They share one image, which each access computes
        anew."""
        image = self.recorded.image
        return tuple(LabelledImage.from_action(image, action, self.grid) for action in self.actions)


def scenes(
    demonstrations: Iterable[Demonstration], grid: PixelGrid, *, later_picks_possible: bool
) -> list[ObservedScene]:
    """Returns the demonstrations' observations in which something is left to pick.

    Args:
        demonstrations: the demonstrations of an expert.
        grid: the pixel grid of their observations.
        later_picks_possible: whether each of the expert's later actions of an episode is already
            possible (see `Learning`).
    """
    result = []
    for demonstration in demonstrations:
        actions = tuple(PickPlaceAction(step.pick, step.place) for step in demonstration.steps)
        for index, step in enumerate(demonstration.steps):
            last = len(actions) if later_picks_possible else index + 1
            result.append(ObservedScene(step, actions[index:last], grid))
    return result


def final_observations(demonstrations: Iterable[Demonstration]) -> list[FinalObservation]:
    """Returns the demonstrations' observations in which nothing is left to pick."""
    return [item.final for item in demonstrations if item.final is not None]


def labelled_images(
    observed: Iterable[ObservedScene], *, taken_only: bool
) -> Sequence[LabelledImage]:
    """Returns the training samples. Their images are made on demand.

    Args:
        observed: the observations.
        taken_only: whether to make only one sample for each observation, with the action that the
            expert took, as in the paper. Otherwise there is one sample for each possible action,
            with the picks of the other actions as `other_picks`.
    """
    return _Samples(list(observed), taken_only)


class _Samples(Sequence[LabelledImage]):
    """Samples made from their observations on demand."""

    def __init__(self, observed: list[ObservedScene], taken_only: bool) -> None:
        self._observed, self._taken_only = observed, taken_only
        self._indices = [
            (scene, target)
            for scene, item in enumerate(observed)
            for target in range(1 if taken_only else len(item.actions))
        ]

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> LabelledImage: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[LabelledImage]: ...

    def __getitem__(self, index: int | slice) -> LabelledImage | Sequence[LabelledImage]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        scene, chosen = self._indices[index]
        targets = self._observed[scene].targets
        if self._taken_only:
            return targets[chosen]
        others = [other for i, other in enumerate(targets) if i != chosen]
        return dataclasses.replace(
            targets[chosen],
            other_picks=np.array([other.pick for other in others]).reshape(-1, 2),
            other_thetas=np.array([other.pick_theta for other in others]),
        )
