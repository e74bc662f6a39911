"""Ranges of configuration numbers, declared beside their defaults.

The dataclasses that use them are YAML schemas of Drake's `yaml_load_typed`, which supports neither
frozen dataclasses nor postponed annotations.
"""

import dataclasses
import math
from typing import Any


def bounded(default: Any, minimum: float = -math.inf, maximum: float = math.inf) -> Any:
    """Declares a dataclass field: a number, or a list of numbers, with a default and an inclusive
    range.

    A list must keep the length of its default.
    """
    if isinstance(default, list):
        metadata = {"range": (minimum, maximum), "length": len(default)}
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata={"range": (minimum, maximum)})


def check_bounds(config: Any, where: str = "") -> None:
    """Checks all numbers of a dataclass, and of the dataclasses, lists and dicts inside it.

    Raises:
        ValueError: a number is not finite or out of its range, or a list has the wrong length. The
            message names the path of the first such field.
    """
    if dataclasses.is_dataclass(config):
        for item in dataclasses.fields(config):
            path = f"{where}.{item.name}" if where else item.name
            value = getattr(config, item.name)
            _check_field(value, item.metadata, path)
            check_bounds(value, path)
    elif isinstance(config, dict):
        for key, value in config.items():
            check_bounds(value, f"{where}.{key}")
    elif isinstance(config, list):
        for index, value in enumerate(config):
            check_bounds(value, f"{where}[{index}]")


def _check_field(value: Any, metadata: Any, path: str) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            _check_field(item, metadata, f"{path}.{key}")
        return
    values = value if isinstance(value, list) else [value]
    length = metadata.get("length", len(values))
    if len(values) != length:
        raise ValueError(f"{path} must hold {length} numbers, not {len(values)}")
    low, high = metadata.get("range", (-math.inf, math.inf))
    for number in values:
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            continue
        if not math.isfinite(number):
            raise ValueError(f"{path} must be a finite number, not {number}")
        if not low <= number <= high:
            raise ValueError(f"{path} must be {_range_text(low, high)}, not {number:g}")


def _range_text(low: float, high: float) -> str:
    if math.isinf(high):
        return f"at least {low:g}"
    if math.isinf(low):
        return f"at most {high:g}"
    return f"between {low:g} and {high:g}"
