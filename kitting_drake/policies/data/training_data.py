"""Data for training or validation, from demonstrations or static scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Demonstrations,
    content_digest,
    read_demonstrations,
)
from kitting_drake.policies.data.images import LabelledImage, Pictured
from kitting_drake.policies.data.learning import Learning
from kitting_drake.policies.data.recorded import FinalObservation, Recorded
from kitting_drake.policies.data.samples import (
    HeightsOnly,
    ObservedScene,
    final_observations,
    labelled_images,
    scenes,
)
from kitting_drake.policies.data.static_scenes import (
    STATIC,
    StaticSamples,
    StaticScenes,
    is_static_scenes,
    read_static_scenes,
)
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose

Item = TypeVar("Item")

_TABLE = ("task", "heightmap")
"""The scenario fields that, with the seed, determine the scene."""
_NO_SCENE = (
    *("tries", "random_order", "distractors"),
    *("success_threshold", "position_threshold", "angle_threshold_deg"),
)
"""Task fields that do not affect where the objects and goals are. (`distractors` only adds boxes to
the scene.)"""


@dataclass(frozen=True)
class TrainingData:
    """Observations and labels from one file."""

    scenario: str
    origin: dict[str, Any]
    """The scenario's fields as JSON values."""
    grid: PixelGrid
    learning: Learning
    colour: bool
    """Whether the images have colours."""
    seeds: tuple[int, ...]
    """The seeds of the demonstrations, or the first seed of static scenes."""
    items: tuple[Demonstration, ...] | StaticScenes
    made_by: dict[str, str]
    """The versions of the packages that made the data, and a digest of the data. They distinguish
    data sets with the same seeds."""

    @property
    def count(self) -> int:
        """The number of demonstrations or static scenes."""
        return len(self.items.scenes if isinstance(self.items, StaticScenes) else self.items)

    @property
    def kind(self) -> str:
        """The name of the items, for messages."""
        return "scenes" if isinstance(self.items, StaticScenes) else "demonstrations"

    @property
    def has_taken(self) -> bool:
        """Whether the data tell which of the possible picks the expert took."""
        return not isinstance(self.items, StaticScenes)

    @property
    def verb(self) -> str:
        """The verb in messages that ask for more data: `draw` or `collect`."""
        return "draw" if isinstance(self.items, StaticScenes) else "collect"

    @property
    def unrelated(self) -> tuple[int, ...]:
        """The places at which the data can be split into two unrelated parts. Each is given as the
        number of items before the split.

        Static scenes share tools within a batch; demonstrations are independent.
        """
        if isinstance(self.items, StaticScenes):
            return self.items.batch_ends
        return tuple(range(1, self.count + 1))

    def part(self, first: int, last: int) -> TrainingData:
        """Returns the items from index `first` up to but not including `last`."""
        if isinstance(self.items, StaticScenes):
            return dataclasses.replace(self, items=self.items.part(first, last))
        items = self.items[first:last]
        return dataclasses.replace(
            self,
            items=items,
            seeds=tuple(item.seed for item in items),
            made_by={**self.made_by, "content": content_digest(items)},
        )

    def scenes(self, most: int | None = None) -> list[ObservedScene]:
        """Returns the observations in which something is left to pick.

        Args:
            most: the largest number of observations to return; None for all. They are evenly
                spaced.
        """
        if not isinstance(self.items, StaticScenes):
            possible = self.learning.later_picks_possible
            found = scenes(self.items, self.grid, later_picks_possible=possible)
            return evenly_chosen(found, most)
        result = []
        loose = [scene for scene in self.items.scenes if len(scene.actions)]
        for scene in evenly_chosen(loose, most):
            actions = tuple(
                PickPlaceAction(PlanarPose(*row[2:5]), PlanarPose(*row[5:8]))
                for row in scene.actions.tolist()
            )
            result.append(ObservedScene(_recorded(Recorded, scene.image), actions, self.grid))
        return result

    def finals(self, most: int | None = None, *, colour: bool = True) -> Sequence[Pictured]:
        """Returns the observations in which nothing is left to pick. For the arguments see `scenes`
        and `samples`."""
        if not isinstance(self.items, StaticScenes):
            found = evenly_chosen(final_observations(self.items), most)
            return found if colour else [HeightsOnly(final) for final in found]
        seated = [scene for scene in self.items.scenes if not len(scene.actions)]
        return [_recorded(FinalObservation, item.image) for item in evenly_chosen(seated, most)]

    def samples(self, *, taken_only: bool, colour: bool = True) -> Sequence[LabelledImage]:
        """Returns training samples from the observations in which something is left to pick.

        Args:
            taken_only: whether to use only the actions that the expert took, see `labelled_images`.
            colour: whether the networks see colours. If not, unseen pixels are filled in, as at
                inference.
        """
        if isinstance(self.items, StaticScenes):
            return StaticSamples(self.items)
        found = self.scenes()
        if not colour:
            found = [
                dataclasses.replace(scene, recorded=HeightsOnly(scene.recorded)) for scene in found
            ]
        return labelled_images(found, taken_only=taken_only)

    def shares_scenes(self, other: TrainingData) -> int | None:
        """Returns a seed for which this and another data set hold the same scene; None if there is
        none."""
        shared = set(self.seeds) & set(other.seeds)
        same = all(_alike(self.origin.get(key), other.origin.get(key)) for key in _TABLE)
        return min(shared) if shared and same else None


def _alike(one: Any, other: Any) -> bool:
    """Whether two values of a scenario field can give the same scenes. Nested fields that only one
    of the values has are ignored, because older files lack some fields."""
    if not isinstance(one, Mapping) or not isinstance(other, Mapping):
        return bool(one == other)
    both = (one.keys() & other.keys()) - {*_NO_SCENE}
    return all(one[key] == other[key] for key in both)


def evenly_chosen(items: list[Item], most: int | None) -> list[Item]:
    """Chooses at most `most` items, evenly spaced; all items if `most` is None."""
    count = len(items) if most is None else min(len(items), most)
    return [items[i * len(items) // count] for i in range(count)]


def _recorded(kind: Any, image: np.ndarray) -> Any:
    return kind(np.zeros((3, *image.shape[1:]), np.uint8), image[3])


def read_training_data(path: Path) -> TrainingData:
    """Reads a file of demonstrations or of static scenes.

    Raises:
        UserError: the file is of neither kind, unreadable or empty.
    """
    if is_static_scenes(path):
        content = read_static_scenes(path)
        data = TrainingData(
            scenario=STATIC,
            origin={"task": STATIC},
            grid=content.grid,
            # Scenes may show symmetric parts, so `many_answers` is set.
            learning=Learning(
                later_picks_possible=True, curvature=True, reflection=True, many_answers=True
            ),
            colour=False,
            seeds=(content.first_seed,),
            items=content,
            made_by={**content.versions, "content": content.digest()},
        )
    else:
        demonstrations: Demonstrations = read_demonstrations(path)
        origin = demonstrations.origin
        # In simulation `z_min` may be below the table. Recordings from a real robot have no such
        # field: their lowest height is the table's.
        z_min = (origin.scenario.get("heightmap") or {}).get("z_min", 0.0)
        if z_min != 0:
            raise UserError(
                f"{path} was collected with heightmap.z_min {z_min:g}, but training needs heights "
                "above the table: collect with z_min 0"
            )
        data = TrainingData(
            scenario=origin.scenario_name,
            origin=origin.scenario,
            grid=origin.grid,
            learning=origin.learning,
            colour=True,
            seeds=tuple(item.seed for item in demonstrations.demonstrations),
            items=demonstrations.demonstrations,
            made_by={
                **origin.versions,
                "content": content_digest(demonstrations.demonstrations),
            },
        )
    if not data.count:
        raise UserError(f"{path} holds no {data.kind}: {data.verb} some first")
    return data
