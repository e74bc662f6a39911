"""The base classes of the Ravens tasks."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.task import MISPLACED, ActionRecord, Scene, TaskConfig
from systems.bounds import bounded
from systems.placement import Placement
from systems.success import PoseWithin

TOPPLED = "toppled"
PREREQUISITE_MISSING = "prerequisite missing"

_GRASP_STREAM = 2
"""The number of the random stream for the demonstrator's grasps. They have their own stream, so
that other draws do not depend on them."""

_UPRIGHT = math.cos(math.radians(20.0))
"""Cosine of the tilt above which an object counts as toppled."""


def grasp_rng(seed: int) -> np.random.Generator:
    """The random generator of the demonstrator's grasps. As in the gripper version of Ravens,
    grasps are away from an object's middle. Their positions thus show along which axis the jaws
    close."""
    return np.random.default_rng([seed, _GRASP_STREAM])


@dataclass
class RavensTask(TaskConfig):
    """Base class of the Ravens tasks, with the title and the causes of failure."""

    causes = (*TaskConfig.causes[:-1], TOPPLED, PREREQUISITE_MISSING, TaskConfig.causes[-1])

    @property
    def learning(self) -> Learning:
        return Learning(many_answers=True)

    @property
    def title(self) -> str:
        words = re.findall("[A-Z][a-z]*", type(self).__name__)
        name = "-".join(words).lower()
        return name if self == type(self)() else f"{name}, changed"

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        cause = super().find_cause(scene, index, X_WB, placement, records)
        if cause != MISPLACED:
            return cause
        if X_WB[index].rotation().matrix()[2, 2] < _UPRIGHT:
            return TOPPLED
        if scene.success.share(placement, X_WB[index]) > 1 - 1e-9:
            # The object is in place, but another goal, which must be filled first, is not filled.
            return PREREQUISITE_MISSING
        return cause


@dataclass
class PoseTask(RavensTask):
    """A task whose objects must come to rest in given poses."""

    # An object is in place if its horizontal distance from its goal is below `position_threshold`,
    # in m, and its heading error below `angle_threshold_deg`, in degrees. The heading error is
    # modulo the object's symmetry.
    position_threshold: float = bounded(0.01, 1e-4, 0.5)
    angle_threshold_deg: float = bounded(15.0, 0.1, 180.0)

    @property
    def success(self) -> PoseWithin:
        """The task's success predicate."""
        return PoseWithin(self.position_threshold, math.radians(self.angle_threshold_deg))
