import dataclasses
from pathlib import Path
from typing import Any

import pytest

from kitting_drake.scenario.yaml_input.yaml_check import check_yaml


@dataclasses.dataclass
class Round:
    radius: float = 1.0


@dataclasses.dataclass
class Square:
    side: float = 1.0
    label: str | None = None


@dataclasses.dataclass
class Box:
    lid: Round | Square = dataclasses.field(default_factory=Round)
    bottoms: list[Round | Square] = dataclasses.field(default_factory=list)
    by_name: dict[str, Square] = dataclasses.field(default_factory=dict)
    count: int = 1
    path: Path = Path()
    note: Square | None = None


@pytest.mark.parametrize(
    "value",
    [
        {},
        {"count": 3, "path": "a/b", "lid": {"radius": 2}},  # An integer counts as a float.
        {"lid": {"_tag": "!Square", "side": 2.0, "label": None}},
        {"bottoms": [{"_tag": "!Square", "side": 2.0}, {"radius": 1.0}]},
        {"by_name": {"a": {"label": "x"}}, "note": None},
    ],
)
def test_accepts(value: Any):
    check_yaml(Box, value, "")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"bottoms": [{}, {"side": 1.0}]}, r"^bottoms\[1\]\.side is an unknown field"),
        ({"lid": {"_tag": "!Sqare"}}, "^lid has the unknown tag !Sqare: did you mean !Square.$"),
        ({"lid": {"_tag": "!Oval"}}, "^lid has the unknown tag !Oval: use one of !Round, !Square$"),
        ({"lid": "Square"}, "^lid must be a mapping, not 'Square': write !Square {}$"),
        ({"lid": {"_tag": 3}}, "^lid has a tag that is not a name: '3'$"),
        ({"lid": {"_tag": "!Square", "radius": 1.0}}, r"^lid\.radius is an unknown field"),
        ({"lid": None}, "^lid is empty"),
        ({"by_name": {"a": {"side": "2e-3"}}}, "a number, not '2e-3': write 0.002$"),
        ({"by_name": {"a": {"side": "wide"}}}, "a number, not 'wide'$"),
        ({"by_name": {"a": {"sid": 1.0}}}, r"^by_name\.a\.sid .* did you mean 'side'"),
        ({"by_name": [1]}, "^by_name must be a mapping from names to values, not a list"),
        ({"note": "here"}, "^note must be a mapping, not 'here'"),
        ({"count": 2.0}, "^count must be a whole number, not '2.0'"),
        ({"count": False}, "^count must be a whole number, not 'False'"),
        ({"path": 3}, "^path must be a path"),
        ({"count": "x" * 100}, r"not 'x{37}\.\.\.'$"),
    ],
)
def test_names_what_is_wrong(value: Any, message: str):
    with pytest.raises(ValueError, match=message):
        check_yaml(Box, value, "")
