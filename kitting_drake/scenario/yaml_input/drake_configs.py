"""Support for Drake's own configs as fields of a scenario."""

import copyreg
from typing import Any

from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.geometry import MeshcatParams
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.sensors import CameraConfig

DRAKE_CONFIGS = (CameraConfig, MeshcatParams, MultibodyPlantConfig)


def struct_fields(schema: Any) -> dict[str, Any] | None:
    """If `schema` is a struct of Drake, the types of its fields by name; otherwise None."""
    fields = getattr(schema, "__fields__", None)
    return None if fields is None else {item.name: item.type for item in fields}


def _load(schema: type, text: str) -> Any:
    return yaml_load_typed(schema=schema, data=text)


def _reduce(config: Any) -> tuple[Any, ...]:
    return _load, (type(config), yaml_dump_typed(config))


# Make the configs picklable, because scenarios are sent to worker processes.
for _config in DRAKE_CONFIGS:
    copyreg.pickle(_config, _reduce)
