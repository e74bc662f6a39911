from systems.given_action import GivenAction
from systems.signals import PickPlaceAction, PlanarPose

ACTION = PickPlaceAction(PlanarPose(0.4, 0.1, 0.2), PlanarPose(0.5, -0.1, 1.0))


def test_it_says_what_it_was_given_last():
    system = GivenAction()
    assert (system.num_input_ports(), system.num_output_ports()) == (0, 1)
    context = system.CreateDefaultContext()
    port = system.GetOutputPort("action")
    assert port.Eval(context) == PickPlaceAction(stop=True)
    system.set_action(context, ACTION)
    assert port.Eval(context) == ACTION


def test_its_memory_is_in_the_context():
    system = GivenAction()
    context = system.CreateDefaultContext()
    system.set_action(context, ACTION)
    port = system.GetOutputPort("action")
    assert port.Eval(context.Clone()) == ACTION
    assert port.Eval(system.CreateDefaultContext()).stop
