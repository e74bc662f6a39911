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


def test_defaults_and_limits_themselves_are_within():
    check_bounds(Outer())
    check_bounds(Inner(speed=0.0, corner=[-1.0, 1.0], count=1))
    check_bounds(Inner(speed=2.0))


def test_defaults_are_not_shared():
    Inner().corner.append(5.0)
    assert Inner().corner == [0.0, 0.0]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (Inner(speed=2.1), "speed must be between 0 and 2, not 2.1"),
        (Inner(speed=-1e-9), "speed must be between 0 and 2"),
        (Inner(speed=math.nan), "speed must be a finite number, not nan"),
        (Inner(count=0), "count must be at least 1, not 0"),
        (Inner(corner=[0.0]), "corner must hold 2 numbers, not 1"),
        (Inner(corner=[0.0, 1.5]), "corner must be between -1 and 1, not 1.5"),
        (Inner(corner=[0.0, math.inf]), "corner must be a finite number"),
        (Outer(inner=Inner(speed=3.0)), r"^inner\.speed must"),
        (Outer(named={"front": Inner(speed=3.0)}), r"^named\.front\.speed must"),
        (Outer(listed=[Inner(), Inner(speed=3.0)]), r"^listed\[1\]\.speed must"),
    ],
)
def test_the_first_number_out_of_bounds_is_named(config: Inner | Outer, message: str):
    with pytest.raises(ValueError, match=message):
        check_bounds(config)
