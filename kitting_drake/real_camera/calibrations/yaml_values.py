"""Reads YAML and JSON files that OpenCV, ROS or people wrote, and converts values to numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

Array = NDArray[np.float64]


class _Loader(yaml.SafeLoader):
    """A loader of YAML that also reads `cv2.FileStorage` matrices, and rejects repeated fields."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Returns the mapping of a node.

        Raises:
            ConstructorError: a field is repeated. PyYAML itself would silently keep the last one.
        """
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        fields = [key.value for key, _ in pairs if isinstance(key, yaml.ScalarNode)]
        repeated = next((name for name in fields if fields.count(name) > 1), None)
        if repeated is not None:
            raise yaml.constructor.ConstructorError(
                problem=f"'{repeated}' is given twice", problem_mark=node.start_mark
            )
        return super().construct_mapping(node, deep)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_text(path: Path) -> str:
    """Returns the text of a file.

    Raises:
        UserError: the file is unreadable or is not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        # A ValueError means that the content is not text, or that the path has a NUL character.
        reason = getattr(error, "strerror", None) or "it is not text"
        raise UserError(f"cannot read {path}: {reason}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Returns the mapping in a YAML or JSON file. Only its first document is read.

    Raises:
        UserError: the file is unreadable or does not hold a mapping.
    """
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, path: Path) -> dict[str, Any]:
    """Returns the mapping in a YAML or JSON text. Only its first document is read.

    Raises:
        UserError: the text does not hold a mapping. The message names the file.
    """
    if text.startswith("%YAML:"):
        # Remove the first line that cv2.FileStorage writes, because it is not a valid YAML
        # directive.
        text = text.partition("\n")[2]
    if path.suffix == ".json" or text.lstrip().startswith("{"):
        # Replace tabs, which JSON allows and YAML forbids.
        text = text.replace("\t", " ")
    try:
        first = next(iter(yaml.load_all(text, _Loader)), None)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}:" if mark else ""
        problem = getattr(error, "problem", None) or "it is not YAML"
        raise UserError(f"{path}:{where} {problem}") from error
    except (ValueError, KeyError, AttributeError) as error:
        # PyYAML raises these for text that resembles a date, or a tag that does not fit its value.
        reason = str(error) if isinstance(error, ValueError) else "a tag does not fit its value"
        raise UserError(f"{path} is not YAML: {reason}") from error
    except RecursionError as error:
        raise UserError(f"{path} is nested too deeply") from error
    if not isinstance(first, dict):
        raise UserError(f"{path} must hold a mapping of fields, such as 'cameras:'")
    return first


def number(value: Any, where: str) -> float:
    """Returns a value as a finite number.

    Raises:
        UserError: the value is something else. The message names the field.
    """
    try:
        # Convert text as well, because YAML 1.1 reads 4e2 as text.
        result = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not math.isfinite(result):
        raise UserError(f"{where} must be a finite number, not {value!r}")
    return result


def whole_number(value: Any, where: str) -> int:
    """Returns a value as a whole number that is at least 1.

    Raises:
        UserError: the value is something else. The message names the field.
    """
    result = number(value, where)
    if result < 1 or result != int(result):
        raise UserError(f"{where} must be a whole number of 1 or more, not {value!r}")
    return int(result)


def numbers(value: Any, where: str) -> Array:
    """Returns a value as a flat array of finite numbers.

    The value may be a list, a list of lists, a matrix of OpenCV or ROS (`rows`, `cols`, `data`), or
    a mapping with x, y, z and possibly w.

    Raises:
        UserError: the value is something else. The message names the field.
    """
    if isinstance(value, dict) and "data" in value:
        value = value["data"]
    elif isinstance(value, dict) and {"x", "y", "z"} <= set(value):
        value = [value[key] for key in "xyzw" if key in value]
    if not isinstance(value, list):
        raise UserError(f"{where} must be a list of numbers, not {value!r}")
    flat = [item for row in value for item in (row if isinstance(row, list) else [row])]
    return np.array([number(item, where) for item in flat])


def matrix(value: Any, rows: int, cols: int, where: str) -> Array:
    """Returns a value as an array of finite numbers with the shape (rows, cols); see `numbers`.

    Raises:
        UserError: the value does not hold rows * cols finite numbers.
    """
    flat = numbers(value, where)
    if flat.size != rows * cols:
        raise UserError(
            f"{where} must hold {rows * cols} numbers ({rows} x {cols}), not {flat.size}"
        )
    return flat.reshape(rows, cols)
