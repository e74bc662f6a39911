"""Loads `task: !PythonTask`, whose fields are those of a user's task class."""

import dataclasses
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load_typed

from kitting_drake.scenario.yaml_input.yaml_check import check_yaml
from kitting_drake.scenario.yaml_input.yaml_text import dumped
from kitting_drake.tasks import Task
from kitting_drake.tasks.python_task import PythonTask, import_task
from kitting_drake.tasks.task import TaskConfig

TAG = "!PythonTask"
_CLASS = "class"


def is_own_task(raw: Any, current: Task) -> bool:
    """Whether a scenario's `task:` is a `!PythonTask`, or is merged over one."""
    if not isinstance(raw, dict):
        return False
    tag = raw.get("_tag")
    return tag == TAG or (tag is None and isinstance(current, PythonTask))


def load_own_task(raw: dict[str, Any], current: Task, base: Path) -> PythonTask:
    """Loads a `!PythonTask`.

    Args:
        raw: the parsed mapping `task:` of the scenario.
        current: the present task. If it has the same class, `raw` is merged over it; otherwise
            `current` is ignored.
        base: the folder of the scenario's file.

    Raises:
        ValueError: a field is invalid. The message begins with the field's path.
        RuntimeError: Drake's YAML loader rejects the mapping.
    """
    fields = {key: value for key, value in raw.items() if key not in ("_tag", _CLASS)}
    reference = raw.get(_CLASS, current.reference if isinstance(current, PythonTask) else None)
    if not isinstance(reference, str):
        raise ValueError("task.class is missing: write !PythonTask {class: my_module:MyTask}")
    kind = import_task(reference, base)
    if not dataclasses.is_dataclass(kind):
        raise ValueError(f"task.class: {reference} must be a dataclass (@dataclass)")
    check_yaml(kind, fields, "task")
    same = isinstance(current, PythonTask) and current.reference == reference
    defaults: TaskConfig = current.config if same else _default(kind)
    config = yaml_load_typed(
        schema=kind, data=dumped(fields), defaults=defaults, retain_map_defaults=same
    )
    return PythonTask(reference, config, base)


def _default(kind: type[TaskConfig]) -> TaskConfig:
    try:
        return kind()
    except TypeError as error:
        raise ValueError(f"task.class: all fields of the class need defaults ({error})") from error
