"""A user's own task, which a scenario names as `module:Class`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.common.own_modules import files_beside, import_own
from kitting_drake.common.provenance import source_files
from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.task import ActionRecord, Scene, TaskConfig
from systems.placement import Placement
from systems.signals import PixelGrid


def import_task(reference: str, base: Path) -> type[TaskConfig]:
    """Imports the class of a task.

    Args:
        reference: `module:Class`. The module must be on Python's path or in `base`.
        base: the folder of the scenario's file.

    Raises:
        ValueError: the import fails, or the class is not a task. The message begins with
            `task.class`.
    """
    module, _, name = reference.partition(":")
    if not module or not name:
        raise ValueError(f"task.class must be module:Class, not '{reference}'")
    try:
        found = import_own(reference, base)
    except (Exception, SystemExit) as error:
        # The import of the module may raise any exception.
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"task.class: cannot import {reference}: {reason}") from error
    if not (isinstance(found, type) and issubclass(found, TaskConfig)):
        raise ValueError(
            f"task.class: {reference} must derive from kitting_drake.tasks.task.TaskConfig"
        )
    return found


@dataclass
class PythonTask(TaskConfig):
    """Your own task, a subclass of `TaskConfig`. In YAML its fields stand beside `class`:

    task: !PythonTask {class: my_module:MyTask, parts: 3}
    """

    reference: str
    """The task's class, as `module:Class`."""
    config: TaskConfig
    """The instance of the task's class."""
    folder: Path = field(default=Path(), metadata={"described": False})
    """The folder of the scenario's file."""

    @property
    def causes(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.config.causes

    @property
    def not_perturbed(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.config.not_perturbed

    @property
    def objects_are_independent(self) -> bool:  # type: ignore[override]
        return self.config.objects_are_independent

    @property
    def title(self) -> str:
        return self.config.title

    @property
    def learning(self) -> Learning:
        return self.config.learning

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        return self.config.make_scene(grid=grid, seed=seed, base=base)

    def input_files(self, base: Path) -> list[Path]:
        return [*self._sources(base), *self.config.input_files(base)]

    def modules(self) -> list[str]:
        return [self.reference.partition(":")[0]]

    def validate(self) -> None:
        self.config.validate()

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        return self.config.find_cause(scene, index, X_WB, placement, records)

    def _sources(self, base: Path) -> list[Path]:
        """The Python files of the module or its package, on which results depend."""
        module = self.modules()[0]
        if beside := files_beside(module, base):
            return beside
        try:
            return source_files(module.partition(".")[0])[1]
        except ImportError as error:
            raise UserError(f"task.class: {error}") from error

    # Pickle the class name and the fields, because the module may exist only beside the scenario.

    def __reduce__(self) -> tuple[object, ...]:
        return _restore, (self.reference, vars(self.config), self.folder)


def _restore(reference: str, fields: dict[str, object], folder: Path) -> PythonTask:
    kind = import_task(reference, folder)
    config = kind.__new__(kind)
    vars(config).update(fields)
    return PythonTask(reference, config, folder)
