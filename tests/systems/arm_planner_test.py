"""The planner with an arm that follows exactly."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem

from systems.arm_kinematics import ArmBase, hand_state
from systems.arm_limits import FR3
from systems.arm_motion import ArmMotion
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.pick_place_planner import PickPlacePlanner
from systems.signals import PickPlaceAction, PlanarPose, SurfaceHeights

BASE = ArmBase(0.1, 0.0, 0.0)
PARAMETERS = PickPlaceParameters(force_limit=140.0)
PICK, PLACE = PlanarPose(0.5, 0.3, 0.5), PlanarPose(0.55, -0.2, -0.8)
TOO_FAR = PlanarPose(0.95, -0.6, 0.0)
HEIGHTS = SurfaceHeights(pick_top=0.03, place_rim=0.05, place_floor=0.0, highest=0.05)
WIDTH, FLOOR = 0.02, 0.004
"""The object's width, and the fingertip height at which it touches the place's floor, in m."""


class PerfectArm(LeafSystem):
    """Follows the desired motion, stops the jaws at the object, and measures the contact forces
    of the pads and the floor. In a retreat something pulls on the hand with a force of `load`."""

    def __init__(self, load: float) -> None:
        super().__init__()
        self._load = load
        for name, size in (("motion", 21), ("opening", 2), ("force", 1), ("mode", 1)):
            self.DeclareVectorInputPort(name, size)
        self.DeclareVectorOutputPort("hand_state", 12, self._calc_state)
        self.DeclareVectorOutputPort("contact", 6, self._calc_contact)

    def _hand(self, context) -> list[float]:
        q, v, _ = np.split(self.GetInputPort("motion").Eval(context), 3)
        return hand_state(q.tolist(), v.tolist(), BASE)

    def _calc_state(self, context, output) -> None:
        hand = self._hand(context)
        opening, rate = self.GetInputPort("opening").Eval(context)
        if opening < WIDTH:
            opening, rate = WIDTH, 0.0
        fingers, rates = [opening / 2] * 2, [rate / 2] * 2
        output.SetFromVector([*hand[:4], *fingers, *hand[4:], *rates])

    def _calc_contact(self, context, output) -> None:
        z, mode = self._hand(context)[2], self.GetInputPort("mode").Eval(context)[0]
        opening, press = self.GetInputPort("opening").Eval(context)[0], self.GetInputPort("force")
        pad = press.Eval(context)[0] + 400 * (WIDTH - opening) if opening <= WIDTH else 0.0
        touch = 1e4 * max(FLOOR - z, 0.0) if mode >= Mode.LOWER else 0.0
        pull = self._load if mode == Mode.RETREAT else 0.0
        output.SetFromVector([0, 0, touch - pull, 0, pad, pad])


class TwoActions(LeafSystem):
    """A policy with one action that is out of reach, one that is within reach, then a stop."""

    def __init__(self) -> None:
        super().__init__()
        self._answers = [
            PickPlaceAction(PICK, TOO_FAR, heights=HEIGHTS),
            PickPlaceAction(PICK, PLACE, heights=HEIGHTS),
            PickPlaceAction(stop=True),
        ]
        self.DeclareVectorInputPort("counts", 4)
        self.DeclareAbstractOutputPort("action", lambda: Value(PickPlaceAction()), self._calc)

    def _calc(self, context, output) -> None:
        output.set_value(self._answers[int(self.GetInputPort("counts").Eval(context)[0])])


def run(load: float = 0.0) -> tuple[list[Mode], tuple, np.ndarray]:
    """The modes of an episode, its attempts, and the commanded motion at each step."""
    builder = DiagramBuilder()
    planner = builder.AddSystem(
        PickPlacePlanner(
            parameters=PARAMETERS, max_actions=5, motion=ArmMotion(PARAMETERS, FR3, BASE)
        )
    )
    arm, policy = builder.AddSystem(PerfectArm(load)), builder.AddSystem(TwoActions())
    for source, target in (
        ("desired_motion", "motion"),
        ("desired_opening", "opening"),
        ("closing_force", "force"),
        ("mode", "mode"),
    ):
        builder.Connect(planner.GetOutputPort(source), arm.GetInputPort(target))
    builder.Connect(arm.GetOutputPort("hand_state"), planner.GetInputPort("hand_state"))
    builder.Connect(arm.GetOutputPort("contact"), planner.GetInputPort("hand_contact_force"))
    builder.Connect(planner.GetOutputPort("counts"), policy.get_input_port())
    builder.Connect(policy.get_output_port(), planner.GetInputPort("action"))
    simulator = Simulator(builder.Build())
    modes: list[Mode] = []
    motions = []

    def look(root) -> EventStatus:
        context = planner.GetMyContextFromRoot(root)
        mode = Mode(int(planner.GetOutputPort("mode").Eval(context)[0]))
        if not modes or modes[-1] != mode:
            modes.append(mode)
        motions.append(planner.GetOutputPort("desired_motion").Eval(context))
        if mode == Mode.DONE:
            return EventStatus.ReachedTermination(planner, "done")
        return EventStatus.DidNothing()

    simulator.set_monitor(look)
    simulator.AdvanceTo(30.0)
    context = planner.GetMyContextFromRoot(simulator.get_context())
    history = planner.GetOutputPort("history").Eval(context)
    return modes, history, np.array(motions)


def test_an_arm_does_what_it_can_reach_and_refuses_the_rest():
    modes, history, motions = run()
    refused = [Mode.OBSERVE, Mode.APPROACH, Mode.RETREAT]
    assert modes == [
        *refused,
        *[mode for mode in Mode if mode < Mode.DONE],
        Mode.OBSERVE,
        Mode.DONE,
    ]
    assert [attempt.outcome for attempt in history] == ["unreachable", "placed"]
    # During the first action, which is refused, the arm does not move.
    moving = np.flatnonzero(np.abs(motions[:, 7:14]).max(axis=1) > 0)
    assert moving[0] / 128 > 0.2


def test_an_arm_goes_down_again_if_an_object_hangs_on_its_hand():
    modes, history, motions = run(load=2.0)
    again = [Mode.RELEASE, Mode.LOWER, Mode.RELEASE, Mode.RETREAT]
    last = [mode for mode in Mode if mode < Mode.DONE]
    assert modes[3:] == [*last, *again, *again, Mode.OBSERVE, Mode.DONE]
    assert [attempt.outcome for attempt in history] == ["unreachable", "placed"]
    # The arm brakes before it goes down: it never jumps.
    assert (np.abs(motions[:, 7:14]) <= FR3.velocity).all()
    assert np.abs(np.diff(motions[:, :7], axis=0)).max() < 0.025


@pytest.mark.slow
def test_a_rerun_is_equal():
    np.testing.assert_array_equal(run()[2], run()[2])
