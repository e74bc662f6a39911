import numpy as np
import pytest
from pydrake.common.value import Value

from systems.pick_place_policy import PickPlacePolicy, PolicyError
from systems.signals import Attempt, Observation, PickPlaceAction, PlanarPose

ACTION = PickPlaceAction(PlanarPose(0.4, 0.1, 0.2), PlanarPose(0.5, -0.1, 1.0))


def observation(value: float) -> Observation:
    return Observation(image=np.full((4, 160, 320), value, np.float32))


@pytest.mark.parametrize("heights_only", [False, True])
def test_ports(heights_only: bool):
    policy = PickPlacePolicy(policy=lambda *_: ACTION, heights_only=heights_only)
    name = "observation_heights" if heights_only else "observation"
    ports = [policy.get_input_port(i).get_name() for i in range(policy.num_input_ports())]
    assert ports == [name, "failed_picks", "history"]
    assert policy.num_output_ports() == 1
    assert isinstance(policy.GetInputPort(name).Allocate().get_value(), Observation)
    assert isinstance(policy.GetOutputPort("action").Allocate().get_value(), PickPlaceAction)
    context = policy.CreateDefaultContext()
    policy.GetInputPort(name).FixValue(context, Value(Observation()))
    assert policy.GetOutputPort("action").Eval(context) == ACTION


def test_the_policy_is_called_once_for_each_observation():
    asked = []

    def answer(o: Observation, _) -> PickPlaceAction:
        asked.append(float(o.image[3, 80, 160]))
        return ACTION

    policy = PickPlacePolicy(policy=answer)
    context = policy.CreateDefaultContext()
    port = policy.GetOutputPort("action")
    policy.GetInputPort("observation").FixValue(context, Value(observation(0.25)))
    assert port.Eval(context) == ACTION
    context.SetTime(1.0)
    port.Eval(context)
    assert asked == [0.25]
    policy.GetInputPort("observation").FixValue(context, Value(observation(0.5)))
    port.Eval(context)
    assert asked == [0.25, 0.5]


def test_a_result_of_the_wrong_type_raises():
    policy = PickPlacePolicy(policy=lambda *_: (0.4, 0.1))  # type: ignore[arg-type, return-value]
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(TypeError, match="PickPlaceAction, not tuple"):
        policy.GetOutputPort("action").Eval(context)


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (PickPlaceAction(pick=(0.3, 0, 0)), TypeError, "PlanarPose as pick"),
        (PickPlaceAction(place=PlanarPose("0.3")), TypeError, "place"),
        (PickPlaceAction(place=PlanarPose(np.nan)), ValueError, "finite"),
        (PickPlaceAction(stop=True, reason="finished"), ValueError, "one of done, nothing fits"),
    ],
)
def test_invalid_actions_raise(answer, error: type, message: str):
    policy = PickPlacePolicy(policy=lambda *_: answer)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(error, match=message):
        policy.GetOutputPort("action").Eval(context)


def test_unused_poses_are_not_checked():
    nowhere = PlanarPose(np.nan, 0, 0)
    for answer in (
        PickPlaceAction(nowhere, nowhere, stop=True),
        PickPlaceAction(PlanarPose(np.float32(0.5), 0, 0), nowhere, press=True),
    ):
        policy = PickPlacePolicy(policy=lambda *_, answer=answer: answer)
        context = policy.CreateDefaultContext()
        policy.GetInputPort("observation").FixValue(context, Value(Observation()))
        assert policy.GetOutputPort("action").Eval(context).press == answer.press


def test_an_exception_in_the_policy_raises_policy_error():
    def fail(*_) -> PickPlaceAction:
        raise KeyError("no such weight")

    policy = PickPlacePolicy(policy=fail)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(PolicyError, match="no such weight") as caught:
        policy.GetOutputPort("action").Eval(context)
    assert isinstance(caught.value.__cause__, KeyError)


def test_failed_picks_are_passed_to_the_policy():
    given = []

    def answer(_: Observation, failed_picks=None) -> PickPlaceAction:
        given.append(failed_picks)
        return ACTION

    policy = PickPlacePolicy(policy=answer)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    port = policy.GetOutputPort("action")
    assert port.Eval(context) == ACTION
    for failed in ((), (PlanarPose(0.4, 0.1, 0.2),)):
        policy.GetInputPort("failed_picks").FixValue(context, Value(failed))
        assert port.Eval(context) == ACTION
    # The function first got no failed picks, because the port was not connected.
    assert given == [(), (), (PlanarPose(0.4, 0.1, 0.2),)]


def test_the_history_is_part_of_the_observation():
    given = []

    def answer(o: Observation, _) -> PickPlaceAction:
        given.append(o.history)
        return ACTION

    policy = PickPlacePolicy(policy=answer)
    context = policy.CreateDefaultContext()
    attempt = Attempt(ACTION, "missed", 3.0)
    policy.GetInputPort("observation").FixValue(context, Value(Observation(history=(attempt,))))
    port = policy.GetOutputPort("action")
    port.Eval(context)
    for history in ((), (attempt, attempt)):
        policy.GetInputPort("history").FixValue(context, Value(history))
        port.Eval(context)
    assert given == [(attempt,), (), (attempt, attempt)]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_action_that_is_not_finite_raises(number: float):
    action = PickPlaceAction(PlanarPose(0.4, 0.1, number), PlanarPose())
    policy = PickPlacePolicy(policy=lambda *_: action)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(ValueError, match="finite"):
        policy.GetOutputPort("action").Eval(context)
