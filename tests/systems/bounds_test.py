import dataclasses
import math

import pytest

from systems.bounds import bounded, check_bounds


@dataclasses.dataclass
class Inner:
    speed: float = bounded(1.0, 0.0, 2.0)
    corner: list[float] = bounded([0.0, 0.0], -1.0, 1.0)
    count: int = bounded(1, 1)
    label: str = "anything"
    flag: bool = True


@dataclasses.dataclass
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    named: dict[str, Inner] = dataclasses.field(default_factory=dict)
    listed: list[Inner] = dataclasses.field(default_factory=list)


def test_defaults_and_inclusive_limits_are_valid():
    check_bounds(Outer())
    check_bounds(Inner(speed=0.0, corner=[-1.0, 1.0], count=1))
    check_bounds(Inner(speed=2.0))


def test_defaults_are_not_shared():
    Inner().corner.append(5.0)
    assert Inner().corner == [0.0, 0.0]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (Inner(speed=2.1), "speed .*2.1"),
        (Inner(speed=-1e-9), "speed"),
        (Inner(speed=math.nan), "speed .*finite"),
        (Inner(count=0), "count .*at least 1"),
        (Inner(corner=[0.0]), "corner .*2 numbers"),
        (Inner(corner=[0.0, 1.5]), "corner .*1.5"),
        (Inner(corner=[0.0, math.inf]), "corner .*finite"),
        (Outer(inner=Inner(speed=3.0)), r"^inner\.speed must"),
        (Outer(named={"front": Inner(speed=3.0)}), r"^named\.front\.speed must"),
        (Outer(listed=[Inner(), Inner(speed=3.0)]), r"^listed\[1\]\.speed must"),
    ],
)
def test_an_error_names_the_first_invalid_number(config: Inner | Outer, message: str):
    with pytest.raises(ValueError, match=message):
        check_bounds(config)
