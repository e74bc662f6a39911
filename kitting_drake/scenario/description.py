"""Converts scenarios to JSON values, for files and comparisons."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.yaml_input.drake_configs import struct_fields


def describe(value: Any) -> Any:
    """Converts a scenario or a part of it, with defaults, to JSON values. The key `_tag` names the
    type of a field with several types."""
    if dataclasses.is_dataclass(value):
        fields = {
            item.name: describe(getattr(value, item.name))
            for item in dataclasses.fields(value)
            if item.metadata.get("described", True)
        }
        return fields if isinstance(value, Scenario) else {"_tag": _tag(value), **fields}
    if (names := struct_fields(type(value))) is not None:
        return {"_tag": _tag(value), **{name: describe(getattr(value, name)) for name in names}}
    if isinstance(value, dict):
        return {key: describe(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [describe(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _tag(value: Any) -> str:
    return f"!{type(value).__name__}"
