import numpy as np
import pytest
from pydrake.common.value import Value

from systems.pick_place_policy import PickPlacePolicy, PolicyError
from systems.signals import Observation, PickPlaceAction, PlanarPose

ACTION = PickPlaceAction(PlanarPose(0.4, 0.1, 0.2), PlanarPose(0.5, -0.1, 1.0))


def observation(value: float) -> Observation:
    return Observation(image=np.full((4, 160, 320), value, np.float32))


@pytest.mark.parametrize("heights_only", [False, True])
def test_ports(heights_only: bool):
    policy = PickPlacePolicy(policy=lambda *_: ACTION, heights_only=heights_only)
    name = "observation_heights" if heights_only else "observation"
    ports = [policy.get_input_port(i).get_name() for i in range(policy.num_input_ports())]
    assert ports == [name, "failed_picks"]
    assert policy.num_output_ports() == 1
    assert isinstance(policy.GetInputPort(name).Allocate().get_value(), Observation)
    assert isinstance(policy.GetOutputPort("action").Allocate().get_value(), PickPlaceAction)
    context = policy.CreateDefaultContext()
    policy.GetInputPort(name).FixValue(context, Value(Observation()))
    assert policy.GetOutputPort("action").Eval(context) == ACTION


def test_is_asked_once_for_each_observation():
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


def test_an_answer_of_another_type_is_refused():
    policy = PickPlacePolicy(policy=lambda *_: (0.4, 0.1))  # type: ignore[arg-type, return-value]
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(TypeError, match="answered with tuple, not a PickPlaceAction"):
        policy.GetOutputPort("action").Eval(context)


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (PickPlaceAction(pick=(0.3, 0, 0)), TypeError, "a pick that is no PlanarPose: .0.3, 0, 0."),
        (PickPlaceAction(place=PlanarPose("0.3")), TypeError, "a place of text"),
        (PickPlaceAction(place=PlanarPose(np.nan)), ValueError, "no finite numbers"),
    ],
)
def test_poses_that_are_no_numbers_are_refused(answer, error: type, message: str):
    policy = PickPlacePolicy(policy=lambda *_: answer)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(error, match=message):
        policy.GetOutputPort("action").Eval(context)


def test_what_means_nothing_is_not_looked_at():
    nowhere = PlanarPose(np.nan, 0, 0)
    for answer in (
        PickPlaceAction(nowhere, nowhere, stop=True),
        PickPlaceAction(PlanarPose(np.float32(0.5), 0, 0), nowhere, press=True),
    ):
        policy = PickPlacePolicy(policy=lambda *_, answer=answer: answer)
        context = policy.CreateDefaultContext()
        policy.GetInputPort("observation").FixValue(context, Value(Observation()))
        assert policy.GetOutputPort("action").Eval(context).press == answer.press


def test_what_the_policy_raises_is_told_as_its_error():
    def fail(*_) -> PickPlaceAction:
        raise KeyError("no such weight")

    policy = PickPlacePolicy(policy=fail)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(PolicyError, match="no such weight") as caught:
        policy.GetOutputPort("action").Eval(context)
    assert isinstance(caught.value.__cause__, KeyError)


def test_a_policy_is_given_where_grasps_failed():
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
    # Not connected: none.
    assert given == [(), (), (PlanarPose(0.4, 0.1, 0.2),)]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_refused(number: float):
    action = PickPlaceAction(PlanarPose(0.4, 0.1, number), PlanarPose())
    policy = PickPlacePolicy(policy=lambda *_: action)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(ValueError, match="answered with no finite numbers"):
        policy.GetOutputPort("action").Eval(context)
