import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from systems.object_feeder import ObjectFeeder
from systems.pick_place_parameters import Mode

FIRST, SECOND, BOWL = 1, 2, 3
AREA = ((0.0, 0.0), (1.0, 1.0))
WAITS = {FIRST: [-20.0, 0.0, -20.0], SECOND: [-21.0, 0.0, -20.0]}
ELSEWHERE = [0.5, 2.0, 0.0]


def arriving(positions: dict[int, list[float]], mode: Mode = Mode.OBSERVE) -> float:
    """The value of the port `arriving`; objects wait unless `positions` (m) says where they are."""
    feeder = ObjectFeeder(
        waiting=[(BodyIndex(body), np.array(WAITS[body])) for body in (FIRST, SECOND)],
        others=[BodyIndex(BOWL)],
        area=AREA,
    )
    context = feeder.CreateDefaultContext()
    where = WAITS | {BOWL: ELSEWHERE} | positions
    poses = [RigidTransform(), *(RigidTransform(where[body]) for body in (FIRST, SECOND, BOWL))]
    feeder.GetInputPort("body_poses").FixValue(context, Value(poses))
    feeder.GetInputPort("mode").FixValue(context, [float(mode)])
    (value,) = feeder.GetOutputPort("arriving").Eval(context)
    return value


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        ({}, 0),
        ({FIRST: ELSEWHERE}, 1),
        ({FIRST: [0.5, 0.5, 0.0]}, -1),
        ({BOWL: [0.5, 0.5, 0.0]}, -1),
        ({FIRST: ELSEWHERE, SECOND: ELSEWHERE}, -1),
        # An object that fell off the table is not waited for: the next one arrives.
        ({FIRST: [0.5, 2.0, -40.0]}, 1),
        ({FIRST: [math.nan] * 3}, 1),
    ],
    ids=["all wait", "one is placed", "one is there", "another is there", "none", "lost", "NaN"],
)
def test_the_next_object_appears_when_the_area_is_clear(
    positions: dict[int, list[float]], expected: float
):
    assert arriving(positions) == expected


@pytest.mark.parametrize("mode", list(Mode))
def test_objects_appear_only_while_the_hand_retreats_or_observes(mode: Mode):
    assert arriving({}, mode) == (0 if mode in (Mode.RETREAT, Mode.OBSERVE) else -1)
