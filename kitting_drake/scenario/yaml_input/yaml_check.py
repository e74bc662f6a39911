"""Checks YAML against a schema of dataclasses, so that an error names the path of the field.

Drake's `yaml_load_typed` does the loading. Its own errors do not name the file, and often not the
field either.
"""

import dataclasses
import difflib
import math
import types
import typing
from pathlib import Path
from typing import Any

from kitting_drake.scenario.yaml_input.drake_configs import struct_fields

_NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}


def check_yaml(schema: Any, value: Any, where: str) -> None:
    """Checks a value that `pydrake.common.yaml.yaml_load` returned against a type of the schema.

    Args:
        schema: a dataclass, a config of Drake's, a union of these, `T | None`, float, int, bool,
            str, Path, `list[T]` or `dict[str, T]`.
        value: the untyped value. The YAML tag of a mapping is under its key `_tag`.
        where: the path to the value, for messages; empty at the root.

    Raises:
        ValueError: the value does not fit the type. The message begins with the value's path.
    """
    origin = typing.get_origin(schema)
    if origin in (types.UnionType, typing.Union):
        _check_union(schema, value, where)
    elif origin is list:
        if not isinstance(value, list):
            raise ValueError(f"{where} must be a list, not {_shown(value)}")
        for index, item in enumerate(value):
            check_yaml(typing.get_args(schema)[0], item, f"{where}[{index}]")
    elif origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{where} must be a mapping from names to values, not {_shown(value)}")
        for key, item in value.items():
            check_yaml(typing.get_args(schema)[1], item, _join(where, key))
    elif struct_fields(schema) is not None:
        _check_struct(schema, value, where)
    elif dataclasses.is_dataclass(schema):
        if isinstance(value, dict) and "_tag" in value:
            tag = str(value["_tag"]).lstrip("!")
            raise ValueError(
                f"{where or 'the scenario'} has the tag !{tag}, but takes no tag: remove it"
            )
        _check_dataclass(schema, value, where)
    else:
        _check_scalar(schema, value, where)


def _check_union(schema: Any, value: Any, where: str) -> None:
    options = [option for option in typing.get_args(schema) if option is not type(None)]
    if value is None:
        if type(None) in typing.get_args(schema):
            return
        raise ValueError(f"{where} is empty: give a value or leave the field out")
    known = [option.__name__ for option in options]
    if len(options) > 1 and value in known:
        raise ValueError(f"{where} must be a mapping, not {_shown(value)}: write !{value} {{}}")
    if len(options) == 1 or not isinstance(value, dict):
        check_yaml(options[0], value, where)
        return
    if not isinstance(value.get("_tag", ""), str):
        raise ValueError(f"{where} has a tag that is not a name: {_shown(value['_tag'])}")
    # As in Drake, an untagged mapping has the first type of the union.
    tag = str(value.get("_tag", options[0].__name__)).lstrip("!")
    for option in options:
        if option.__name__ == tag:
            if dataclasses.is_dataclass(option):
                _check_dataclass(option, value, where)
            else:
                _check_struct(option, value, where)
            return
    close = difflib.get_close_matches(tag, known, n=1)
    every = ", ".join(f"!{name}" for name in known)
    advice = f"did you mean !{close[0]}?" if close else f"use one of {every}"
    raise ValueError(f"{where} has the unknown tag !{tag}: {advice}")


def _check_dataclass(schema: Any, value: Any, where: str) -> None:
    if not isinstance(value, dict):
        raise ValueError(f"{where or 'the scenario'} must be a mapping, not {_shown(value)}")
    types_by_name = typing.get_type_hints(schema)
    # Use only the dataclass fields, because a class may also annotate other attributes.
    hints = {item.name: types_by_name[item.name] for item in dataclasses.fields(schema)}
    _check_names(hints, value, where)
    for key, item in value.items():
        if key != "_tag":
            check_yaml(hints[key], item, _join(where, key))


def _check_struct(schema: Any, value: Any, where: str) -> None:
    """Checks one of Drake's structs: the names of its fields, and the values that are numbers,
    booleans or strings. Drake checks the other values."""
    hints = struct_fields(schema) or {}
    if not isinstance(value, dict):
        raise ValueError(f"{where} must be a mapping, not {_shown(value)}")
    _check_names(hints, value, where)
    for key, item in value.items():
        if hints.get(key) in _NAMES:
            _check_scalar(hints[key], item, _join(where, key))


def _check_names(hints: dict[str, Any], value: dict, where: str) -> None:
    for key in value:
        if key != "_tag" and key not in hints:
            close = difflib.get_close_matches(str(key), hints, n=1)
            known = f"use one of {', '.join(hints)}" if hints else "it has none"
            advice = f"did you mean '{close[0]}'?" if close else known
            raise ValueError(f"{_join(where, key)} is an unknown field: {advice}")


def _check_scalar(schema: Any, value: Any, where: str) -> None:
    if value is None:
        raise ValueError(f"{where} is empty: give a value or leave the field out")
    accepted: tuple[type, ...] = {float: (float, int), Path: (str,)}.get(schema, (schema,))
    if not isinstance(value, accepted) or (isinstance(value, bool) and schema is not bool):
        advice = _float_advice(value) if schema is float else ""
        wanted = _NAMES.get(schema, "a path")
        raise ValueError(f"{where} must be {wanted}, not {_shown(value)}{advice}")


def _float_advice(value: Any) -> str:
    """Says how to write a number that YAML reads as a string, such as 1e-3."""
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        number = math.nan
    return f": write {number!r}" if math.isfinite(number) else ""


def _join(where: str, key: object) -> str:
    return f"{where}.{key}" if where else str(key)


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if value is None:
        return "empty"
    text = str(value)
    return f"'{text if len(text) <= 40 else text[:37] + '...'}'"
