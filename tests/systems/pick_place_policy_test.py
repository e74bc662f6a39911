import numpy as np
import pytest
from pydrake.common.value import Value

from systems.pick_place_policy import PickPlacePolicy
from systems.signals import Observation, PickPlaceAction, PlanarPose

ACTION = PickPlaceAction(PlanarPose(0.4, 0.1, 0.2), PlanarPose(0.5, -0.1, 1.0))


def observation(value: float) -> Observation:
    return Observation(image=np.full((4, 160, 320), value, np.float32))


def test_ports():
    policy = PickPlacePolicy(policy=lambda _: ACTION)
    assert policy.num_input_ports() == policy.num_output_ports() == 1
    assert isinstance(policy.GetInputPort("observation").Allocate().get_value(), Observation)
    assert isinstance(policy.GetOutputPort("action").Allocate().get_value(), PickPlaceAction)


def test_is_asked_once_for_each_observation():
    asked = []

    def answer(o: Observation) -> PickPlaceAction:
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
    policy = PickPlacePolicy(policy=lambda _: (0.4, 0.1))  # type: ignore[arg-type, return-value]
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
    policy = PickPlacePolicy(policy=lambda _: answer)
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
        policy = PickPlacePolicy(policy=lambda _, answer=answer: answer)
        context = policy.CreateDefaultContext()
        policy.GetInputPort("observation").FixValue(context, Value(Observation()))
        assert policy.GetOutputPort("action").Eval(context).press == answer.press


def test_what_the_policy_raises_comes_through():
    def fail(_: Observation) -> PickPlaceAction:
        raise KeyError("no such weight")

    policy = PickPlacePolicy(policy=fail)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(KeyError, match="no such weight"):
        policy.GetOutputPort("action").Eval(context)


def test_a_function_of_two_arguments_is_told_where_grasps_failed():
    told = []

    def answer(_: Observation, failed_picks: tuple[PlanarPose, ...]) -> PickPlaceAction:
        told.append(failed_picks)
        return ACTION

    policy = PickPlacePolicy(policy=answer)
    assert policy.num_input_ports() == 2
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    for failed in ((), (PlanarPose(0.4, 0.1, 0.2),)):
        policy.GetInputPort("failed_picks").FixValue(context, Value(failed))
        assert policy.GetOutputPort("action").Eval(context) == ACTION
    assert told == [(), (PlanarPose(0.4, 0.1, 0.2),)]


def test_failed_picks_are_found_by_their_name():
    told = []

    def last(_: Observation, threshold: float = 0.5, *, failed_picks=()) -> PickPlaceAction:
        told.append((threshold, failed_picks))
        return ACTION

    def third(_: Observation, threshold: float = 0.5, failed_picks=()) -> PickPlaceAction:
        return last(_, threshold, failed_picks=failed_picks)

    for function in (last, third):
        policy = PickPlacePolicy(policy=function)
        context = policy.CreateDefaultContext()
        policy.GetInputPort("observation").FixValue(context, Value(Observation()))
        policy.GetInputPort("failed_picks").FixValue(context, Value((ACTION.pick,)))
        assert policy.GetOutputPort("action").Eval(context) == ACTION
    assert told == [(0.5, (ACTION.pick,))] * 2


def test_an_option_of_a_function_is_its_own():
    thresholds = []

    def answer(_: Observation, threshold: float = 0.5) -> PickPlaceAction:
        thresholds.append(threshold)
        return ACTION

    policy = PickPlacePolicy(policy=answer)
    assert policy.num_input_ports() == 1
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    policy.GetOutputPort("action").Eval(context)
    assert thresholds == [0.5]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_refused(number: float):
    action = PickPlaceAction(PlanarPose(0.4, 0.1, number), PlanarPose())
    policy = PickPlacePolicy(policy=lambda _: action)
    context = policy.CreateDefaultContext()
    policy.GetInputPort("observation").FixValue(context, Value(Observation()))
    with pytest.raises(ValueError, match="answered with no finite numbers"):
        policy.GetOutputPort("action").Eval(context)
