import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from systems.insertion_search import InsertionSearch
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.pick_place_planner import PickPlacePlanner
from systems.signals import (
    LeftOver,
    Observation,
    PickPlaceAction,
    PixelGrid,
    PlanarPose,
    SurfaceHeights,
)

PICK, PLACE = PlanarPose(0.4, 0.3, 0.5), PlanarPose(0.55, -0.2, -0.8)
HEIGHTS = SurfaceHeights(pick_top=0.05, highest=0.06)
ACTION = PickPlaceAction(PICK, PLACE, heights=HEIGHTS)
# PerfectHand is far stiffer than a real hand, so the force limit is high.
PARAMETERS = PickPlaceParameters(grasp_depth_share=0.0, force_limit=140.0)
TEN = 10
"""The largest number of actions in most tests."""
GRASP_Z = 0.05 - PARAMETERS.grasp_depth
HANGING = GRASP_Z
"""How far the held object extends below the fingertips. It stood on the table when gripped."""
WIDTH, WEIGHT = 0.02, 6.0
LIGHT = dataclasses.replace(PARAMETERS, heavy_load=2 * WEIGHT)
"""Parameters with which the object is light, so that its grasp is not tried out."""
NO_TOUCH = -1.0

PICK_AND_PLACE = [mode for mode in Mode if mode < Mode.DONE]


def mode_of(planner: PickPlacePlanner, context: Context) -> Mode:
    return Mode(int(planner.GetOutputPort("mode").Eval(context)[0]))


@dataclasses.dataclass
class World:
    """The surfaces and the object that the hand touches.

    Attributes:
        touch_pick: the fingertip height at which the fingertips touch something on the pick side,
            in m.
        touch_place: the fingertip height at which the held object touches something on the place
            side, in m.
        cavity: (lowest yaw, highest yaw, height). Between these yaws of the hand, the object enters
            a cavity on the place side, and `height` replaces `touch_place`.
        stiffness: the stiffness of the surfaces, in N/m.
        width: the object's width between the pads in m, by attempt (from 1) and mode.
        levers: by attempt, the distance (m) along the pads from the grasp to the object's centre
            of mass; zero for other attempts.
        leaves: the height above the grasp up to which the table bears half of the object's weight,
            in m.
        sticks: whether the jaws stick at the release, until a force opens them.
        slips: the speed, in m/s, at which the jaws close in `LIFT` in the first attempt, once the
            hand has risen by 5 mm.
    """

    touch_pick: float = NO_TOUCH
    touch_place: float = 0.04
    cavity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stiffness: float = 1e5
    width: Callable[[int, Mode], float] = lambda attempt, mode: WIDTH
    levers: tuple[float, ...] = ()
    leaves: float = 0.0
    sticks: bool = False
    slips: float = 0.0


@dataclasses.dataclass
class Jam(World):
    """A world that adds a force (x, y, z), in N, to what the hand feels in one mode."""

    mode: Mode = Mode.CARRY
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)


class PerfectHand(LeafSystem):
    """Follows the desired motion exactly, stops the jaws at the object, and feels contacts."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world
        for name, size in (
            ("desired_motion", 12),
            ("desired_opening", 2),
            ("closing_force", 1),
            ("mode", 1),
            ("counts", 4),
        ):
            self.DeclareVectorInputPort(name, size)
        self.DeclareVectorOutputPort("hand_state", 12, self._calc_state)
        self.DeclareVectorOutputPort("hand_contact_force", 6, self._calc_contact)
        self.DeclareVectorOutputPort("wrist_moment", 1, self._calc_moment)

    def _eval(self, context: Context, name: str) -> NDArray:
        return self.GetInputPort(name).Eval(context)

    def _width(self, context: Context) -> float:
        attempt, mode = self._eval(context, "counts")[0], self._eval(context, "mode")[0]
        return self._world.width(int(attempt), Mode(int(mode)))

    def _lever(self, context: Context) -> float:
        levers = dict(enumerate(self._world.levers, start=1))
        return levers.get(int(self._eval(context, "counts")[0]), 0.0)

    def _calc_moment(self, context, output) -> None:
        pull = 1 + self._eval(context, "desired_motion")[10] / 9.81
        output.SetFromVector([WEIGHT * pull * self._lever(context)])

    def _calc_state(self, context, output) -> None:
        q, v, _ = np.split(self._eval(context, "desired_motion"), 3)
        opening, rate = self._eval(context, "desired_opening")
        releases = self._eval(context, "mode")[0] == Mode.RELEASE
        is_pushed_open = self._eval(context, "closing_force")[0] < -5
        sticks = self._world.sticks and releases and not is_pushed_open
        if opening < self._width(context) or sticks:
            opening, rate = self._width(context), 0.0
        lifts = self._eval(context, "mode")[0] == Mode.LIFT and q[2] > GRASP_Z + 0.005
        if lifts and self._eval(context, "counts")[0] == 1:
            rate -= self._world.slips
        fingers, rates = [opening / 2] * 2, [rate / 2] * 2
        output.SetFromVector(np.concatenate([q, fingers, v, rates]))

    def _calc_contact(self, context, output) -> None:
        q = self._eval(context, "desired_motion")[:4]
        opening = self._eval(context, "desired_opening")[0]
        press = self._eval(context, "closing_force")[0]
        width = self._width(context)
        pad = 800 * (width - opening) / 2 + press if width > 0 and opening <= width else 0.0
        first, last, floor = self._world.cavity
        place = floor if first < q[3] < last else self._world.touch_place
        side = self._world.touch_pick if q[1] > 0 else place
        touch = max(side - q[2], 0.0) * self._world.stiffness
        in_the_air = self._eval(context, "mode")[0] >= Mode.LIFT
        # The held object adds its weight and inertia.
        mass = WEIGHT / 9.81 if in_the_air and press > 0 and pad > 0 else 0.0
        if q[1] > 0 and q[2] < GRASP_Z + self._world.leaves:
            mass /= 2
        load = -mass * (self._eval(context, "desired_motion")[8:11] + [0, 0, 9.81])
        force = np.array([*load, 0, pad, pad]) + [0, 0, touch, 0, 0, 0]
        world = self._world
        if isinstance(world, Jam) and self._eval(context, "mode")[0] == world.mode:
            force[:3] += world.force
        output.SetFromVector(force)


class StubPolicy(LeafSystem):
    """Returns one action a number of times, then a stop; records the times at which it is asked."""

    def __init__(self, actions: int, answer: PickPlaceAction) -> None:
        super().__init__()
        self.answers = [answer] * actions
        self.asked: list[float] = []
        self.DeclareAbstractOutputPort("action", lambda: Value(PickPlaceAction()), self._calc)

    def _calc(self, context, output) -> None:
        self.asked.append(context.get_time())
        stop = len(self.asked) > len(self.answers)
        output.set_value(PickPlaceAction(stop=True) if stop else self.answers[len(self.asked) - 1])


class Run:
    """The planner, a perfect hand and a stub policy, simulated until the planner is done."""

    def __init__(
        self,
        world: World | None = None,
        *,
        actions: int = 1,
        answer: PickPlaceAction | None = None,
        parameters: PickPlaceParameters = PARAMETERS,
        insertion: bool = False,
        observation: Observation | None = None,
        is_logged: bool = False,
    ) -> None:
        if answer is None:
            answer = ACTION if observation is None else PickPlaceAction(PICK, PLACE)
        builder = DiagramBuilder()
        self.planner = builder.AddSystem(
            PickPlacePlanner(parameters=parameters, max_actions=TEN, insertion=insertion)
        )
        self.policy = builder.AddSystem(StubPolicy(actions, answer))
        hand = builder.AddSystem(PerfectHand(world or World()))
        for port in ("desired_motion", "desired_opening", "closing_force", "mode", "counts"):
            builder.Connect(self.planner.GetOutputPort(port), hand.GetInputPort(port))
        for port in ("hand_state", "hand_contact_force", "wrist_moment"):
            builder.Connect(hand.GetOutputPort(port), self.planner.GetInputPort(port))
        builder.Connect(self.policy.get_output_port(), self.planner.GetInputPort("action"))
        # Logging doubles the time of a run.
        if is_logged:
            self.log = LogVectorOutput(
                self.planner.GetOutputPort("desired_motion"), builder, 1 / 128
            )
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        if observation is not None:
            context = self.planner.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
            self.planner.GetInputPort("observation").FixValue(context, Value(observation))
        self.modes: list[tuple[float, Mode]] = []
        self.simulator.set_monitor(self._look)

    def _look(self, root: Context) -> EventStatus:
        mode = mode_of(self.planner, self.planner.GetMyContextFromRoot(root))
        if not self.modes or self.modes[-1][1] != mode:
            self.modes.append((root.get_time(), mode))
        if mode == Mode.DONE:
            return EventStatus.ReachedTermination(self.planner, "done")
        return EventStatus.DidNothing()

    def finish(self) -> "Run":
        self.simulator.AdvanceTo(100.0)
        assert self.modes[-1][1] == Mode.DONE, self.modes
        return self

    def until(self, mode: Mode) -> "Run":
        """Runs until a mode has just begun; returns this run."""
        while not self.modes or self.modes[-1][1] != mode:
            assert self.simulator.get_context().get_time() < 100
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + 1 / 64)
        return self

    def output(self, name: str) -> NDArray:
        context = self.planner.GetMyContextFromRoot(self.simulator.get_context())
        return self.planner.GetOutputPort(name).Eval(context)

    @property
    def sequence(self) -> list[Mode]:
        return [mode for _, mode in self.modes]

    @property
    def counts(self) -> list[float]:
        """The numbers of actions begun, grasps missed, and objects dropped."""
        return self.output("counts").tolist()[:3]


def test_ports():
    planner = PickPlacePlanner(parameters=PARAMETERS, max_actions=TEN)
    assert planner.num_input_ports() == 5
    assert isinstance(planner.GetInputPort("observation").Allocate().get_value(), Observation)
    assert planner.GetInputPort("hand_state").size() == 12
    assert planner.GetInputPort("hand_contact_force").size() == 6
    assert isinstance(planner.GetInputPort("action").Allocate().get_value(), PickPlaceAction)
    outputs = {
        "desired_motion": 12,
        "desired_opening": 2,
        "closing_force": 1,
        "mode": 1,
        "counts": 4,
        "peak_force": 3,
        "payload": 1,
        "asks": 1,
    }
    assert planner.num_output_ports() == len(outputs) + 3
    context = planner.CreateDefaultContext()
    assert planner.GetOutputPort("failed_picks").Eval(context) == ()
    assert planner.GetOutputPort("history").Eval(context) == ()
    assert not planner.GetOutputPort("accepted_action").Eval(context).press
    for name, size in outputs.items():
        assert planner.GetOutputPort(name).size() == size


def test_the_hand_starts_at_home_with_open_jaws():
    planner = PickPlacePlanner(parameters=PARAMETERS, max_actions=TEN)
    context = planner.CreateDefaultContext()
    motion = planner.GetOutputPort("desired_motion").Eval(context)
    np.testing.assert_array_equal(motion, [*PARAMETERS.home, *np.zeros(8)])
    opening = planner.GetOutputPort("desired_opening").Eval(context)
    np.testing.assert_array_equal(opening, [PARAMETERS.open_width, 0])
    assert mode_of(planner, context) == Mode.OBSERVE


def test_all_modes_of_a_pick_and_place_in_order():
    run = Run().finish()
    assert run.sequence == [*PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]
    assert run.counts == [1, 0, 0]


def test_the_hand_reaches_the_commanded_poses():
    run = Run()
    run.until(Mode.CLOSE)
    np.testing.assert_allclose(run.output("desired_motion")[:3], [PICK.x, PICK.y, GRASP_Z])
    turned = run.output("desired_motion")[3]
    run.until(Mode.LIFT)
    assert run.output("closing_force")[0] == PARAMETERS.grasp_force
    assert run.output("desired_opening")[0] == pytest.approx(WIDTH, abs=1e-3)
    run.until(Mode.LOWER)
    over_place = [PLACE.x, PLACE.y, HANGING + PARAMETERS.hover_clearance]
    np.testing.assert_allclose(run.output("desired_motion")[:3], over_place, atol=1e-4)
    context = run.planner.GetMyContextFromRoot(run.simulator.get_context())
    accepted = run.planner.GetOutputPort("accepted_action").Eval(context)
    pick, place = accepted.pick, accepted.place
    assert (pick.x, pick.y, pick.theta) == (PICK.x, PICK.y, pytest.approx(turned))
    assert (place.x, place.y) == (PLACE.x, PLACE.y)
    # The object rotates exactly as the action says, but the hand may be turned by pi at both ends.
    assert run.output("desired_motion")[3] - turned == pytest.approx(PLACE.theta - PICK.theta)
    run.until(Mode.RETREAT)
    assert run.output("closing_force")[0] == 0
    opened = WIDTH + 2 * PARAMETERS.release_clearance
    assert run.output("desired_opening")[0] == pytest.approx(opened, abs=1e-3)
    yaw = run.output("desired_motion")[3]
    run.finish()
    home_x, _, home_z, _ = PARAMETERS.home
    np.testing.assert_allclose(
        run.output("desired_motion"), [home_x, PLACE.y, home_z, yaw, *np.zeros(8)], atol=1e-9
    )


@pytest.mark.parametrize(("heavy_load", "firm"), [(WEIGHT - 0.5, True), (8 * WEIGHT, False)])
def test_a_heavy_object_is_gripped_more_firmly_until_its_release(heavy_load: float, firm: bool):
    parameters = dataclasses.replace(
        PARAMETERS, heavy_load=heavy_load, peak_grasp_force=PARAMETERS.firm_grasp_force
    )
    run = Run(parameters=parameters).until(Mode.LIFT)
    assert run.output("closing_force")[0] == parameters.grasp_force
    run.until(Mode.LOWER)
    force = parameters.firm_grasp_force if firm else parameters.grasp_force
    assert run.output("closing_force")[0] == force
    run.until(Mode.RETREAT)
    assert run.output("closing_force")[0] == 0
    run.finish()
    assert run.sequence == [*PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]


@pytest.mark.parametrize("lever", [-0.05, 0.05])
def test_an_object_that_would_turn_is_set_down_where_it_was_and_its_balance_is_told(lever: float):
    run = Run(World(levers=(lever,), touch_place=0.0), actions=2).until(Mode.RELEASE)
    assert Mode.CARRY not in run.sequence
    here = run.output("desired_motion")
    np.testing.assert_allclose(here[:2], [PICK.x, PICK.y], atol=1e-9)
    assert here[2] < GRASP_Z
    run.finish()
    set_down, placed = run.output("history")
    assert (set_down.outcome, placed.outcome) == ("set down", "placed")
    assert placed.balance is None
    assert set_down.floor is None and placed.floor == pytest.approx(HEIGHTS.place_floor)
    # The accepted pick's theta may differ from the given one by pi.
    theta = set_down.action.pick.theta
    felt = np.array(set_down.balance) - (PICK.x, PICK.y)
    np.testing.assert_allclose(felt, lever * np.array([np.cos(theta), np.sin(theta)]), atol=1e-3)
    assert run.counts == [2, 0, 0]


def resting_heights(run: Run) -> NDArray:
    """The heights at which the hand was at rest during a run, in m."""
    motion = run.log.FindLog(run.simulator.get_context()).data()
    return motion[2, np.abs(motion[4:8]).max(axis=0) == 0.0]


@pytest.mark.parametrize(("lever", "is_tried"), [(0.005, False), (0.02, True)])
def test_the_hand_sees_first_how_a_long_object_hangs(lever: float, is_tried: bool):
    parameters = dataclasses.replace(PARAMETERS, heavy_load=8 * WEIGHT)
    world = World(levers=(lever,), touch_place=0.0)
    run = Run(world, parameters=parameters, is_logged=True).until(Mode.CARRY)
    rested = resting_heights(run) - GRASP_Z
    assert ((rested > 0.008) & (rested < 0.015)).any() == is_tried
    assert [item.outcome for item in run.finish().output("history")] == ["placed"]


def test_jaws_that_stick_to_the_object_are_opened_with_force():
    run = Run(World(sticks=True)).until(Mode.RETREAT)
    assert run.modes[-1][0] - run.modes[-2][0] < 0.5
    opened = WIDTH + 2 * PARAMETERS.release_clearance
    assert run.output("desired_opening")[0] == pytest.approx(opened, abs=1e-3)
    run.finish()
    assert run.sequence == [*PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]


@pytest.mark.parametrize("height", [0.02, 0.045])
def test_lowering_stops_at_contact(height: float):
    run = Run(World(touch_place=height)).until(Mode.RELEASE)
    z = run.output("desired_motion")[2]
    # The planner updates every 1/64 s, so it stops at most one period late.
    assert height - PARAMETERS.lower_speed / 64 - 1e-4 <= z < height
    run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 0.05)
    assert run.sequence[-1] == Mode.RELEASE
    assert run.output("desired_motion")[2] == z


def test_contact_force_is_measured_relative_to_the_payload():
    """On a soft surface, the hand stops 2 mm deep, at 4 N beyond the object's weight."""
    soft = World(touch_place=0.04, stiffness=2000.0)
    run = Run(soft).until(Mode.RELEASE)
    deep = PARAMETERS.contact_threshold / soft.stiffness
    z = run.output("desired_motion")[2]
    assert 0.04 - deep - 2 * PARAMETERS.lower_speed / 64 <= z < 0.04 - deep


def test_lowering_without_contact_ends_above_the_table():
    run = Run(World(touch_place=NO_TOUCH)).until(Mode.RELEASE)
    assert run.output("desired_motion")[2] == pytest.approx(PARAMETERS.floor_clearance)


RIM = 0.03
ON_THE_RIM, IN_THE_CAVITY = GRASP_Z + RIM, GRASP_Z + RIM - 0.015
OVER_A_CAVITY = dataclasses.replace(ACTION, heights=dataclasses.replace(HEIGHTS, place_rim=RIM))


@pytest.mark.parametrize("offset", [-0.1, -0.05, 0.05, 0.1])
def test_an_object_on_the_rim_is_rotated_into_its_cavity(offset: float):
    yaw = PLACE.theta + offset
    world = World(touch_place=ON_THE_RIM, cavity=(yaw - 0.02, yaw + 0.02, IN_THE_CAVITY))
    run = Run(world, answer=OVER_A_CAVITY, insertion=True).until(Mode.RELEASE)
    assert set(run.sequence[run.sequence.index(Mode.LOWER) :]) == {
        Mode.LOWER,
        Mode.SEARCH,
        Mode.RELEASE,
    }
    assert run.sequence[-2] == Mode.LOWER
    q = run.output("desired_motion")[:4]
    assert q[2] == pytest.approx(IN_THE_CAVITY, abs=2e-3)
    assert q[3] == pytest.approx(yaw, abs=0.025)
    assert run.finish().counts == [1, 0, 0]


@pytest.mark.parametrize(("doubt", "follows"), [(0.0, Mode.RELEASE), (0.002, Mode.SEARCH)])
def test_the_rim_check_allows_for_the_doubt_of_the_heights(doubt: float, follows: Mode):
    """If heights are doubtful, an object that stops just below the rim may in fact stand on it."""
    heights = dataclasses.replace(OVER_A_CAVITY.heights, doubt=doubt)
    world = World(touch_place=ON_THE_RIM - 0.0015)
    answer = dataclasses.replace(OVER_A_CAVITY, heights=heights)
    run = Run(world, answer=answer, insertion=True).until(follows)
    assert run.sequence[-2:] == [Mode.LOWER, follows]


def test_a_failed_search_ends_where_it_began():
    run = Run(
        World(touch_place=ON_THE_RIM), answer=OVER_A_CAVITY, insertion=True, is_logged=True
    ).until(Mode.RELEASE)
    assert run.sequence[-2] == Mode.SEARCH
    q = run.output("desired_motion")[:4]
    assert q[2] == pytest.approx(ON_THE_RIM, abs=2.5e-3)
    np.testing.assert_allclose(q[[0, 1, 3]], (PLACE.x, PLACE.y, PLACE.theta), atol=1e-9)
    # The search rotates in both directions and follows the spiral, up to its limits.
    began = next(time for time, mode in run.modes if mode == Mode.SEARCH)
    log = run.log.FindLog(run.simulator.get_context())
    searched = log.data()[:4, log.sample_times() > began]
    search = PARAMETERS.search
    assert (searched[3] - PLACE.theta).min() == pytest.approx(-search.amplitude, abs=1e-3)
    strayed = np.hypot(searched[0] - PLACE.x, searched[1] - PLACE.y)
    assert strayed.max() == pytest.approx(search.reach, abs=1e-4)
    assert np.ptp(searched[0]) > 1.5 * search.reach
    assert np.ptp(searched[1]) > 1.5 * search.reach
    assert run.finish().sequence[-1] == Mode.DONE


@pytest.mark.parametrize(
    ("touched", "insertion", "amplitude"),
    [(IN_THE_CAVITY, True, 0.12), (ON_THE_RIM, False, 0.12), (ON_THE_RIM, True, 0.0)],
    ids=["in its cavity", "no insertion", "not wanted"],
)
def test_no_search_is_made(touched: float, insertion: bool, amplitude: float):
    parameters = dataclasses.replace(
        PARAMETERS, search=InsertionSearch(amplitude=amplitude, reach=amplitude / 30)
    )
    run = Run(
        World(touch_place=touched),
        answer=OVER_A_CAVITY,
        parameters=parameters,
        insertion=insertion,
    ).finish()
    assert run.sequence == [*PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]


@pytest.mark.parametrize(("doubt", "searches"), [(0.0, True), (0.002, False)])
def test_no_search_is_made_if_the_fingertips_may_touch_the_rim(doubt: float, searches: bool):
    """A thin object can sink by 1.5 mm at most, which is less than the doubt of the heights."""
    thin = dataclasses.replace(HEIGHTS, pick_top=0.008, place_rim=RIM, doubt=doubt)
    world = World(touch_place=PARAMETERS.floor_clearance + RIM)
    run = Run(world, answer=dataclasses.replace(ACTION, heights=thin), insertion=True).finish()
    assert (Mode.SEARCH in run.sequence) is searches


def test_an_object_placed_on_the_table_is_released_without_a_search():
    """There is no search even in insertion tasks, because the table has no cavity."""
    run = Run(World(touch_place=GRASP_Z), insertion=True).finish()
    assert run.sequence == [*PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]


def test_the_rim_check_allows_for_the_height_of_the_support():
    """If the object was picked from a support of 20 mm, its bottom is 20 mm nearer to the hand."""
    on_a_box = dataclasses.replace(HEIGHTS, support=0.02, place_rim=RIM)
    answer = dataclasses.replace(ACTION, heights=on_a_box)
    run = Run(World(touch_place=ON_THE_RIM - 0.02), answer=answer, insertion=True).finish()
    assert Mode.SEARCH in run.sequence
    run = Run(World(touch_place=ON_THE_RIM - 0.025), answer=answer, insertion=True).finish()
    assert Mode.SEARCH not in run.sequence


def seen(**heights: float) -> Observation:
    """A table with surfaces at the pick and the place and a block in a corner, at given heights."""
    grid = PixelGrid()
    image = np.full((4, *grid.shape), 0.5, np.float32)
    image[3] = heights.get("table", 0.0)
    image[3, :10, :10] = heights.get("tallest", 0.0)
    for pose, height in ((PICK, heights.get("pick", 0.0)), (PLACE, heights.get("place", 0.0))):
        row, col = np.rint(grid.to_pixel((pose.x, pose.y))).astype(int)
        image[3, row - 1 : row + 2, col - 1 : col + 2] = height
    return Observation(image, grid)


def test_heights_come_from_the_action_or_else_from_the_observation():
    run = Run(observation=seen(table=0.01, pick=0.04), answer=ACTION).until(Mode.CLOSE)
    assert run.output("desired_motion")[2] == pytest.approx(GRASP_Z)
    run = Run(observation=seen(table=0.01, pick=0.04)).until(Mode.CLOSE)
    assert run.output("desired_motion")[2] == pytest.approx(0.04 - PARAMETERS.grasp_depth)
    # The hand stays above the table, whatever the table's height is.
    run = Run(observation=seen(table=0.01, pick=0.021)).until(Mode.CLOSE)
    assert run.output("desired_motion")[2] == pytest.approx(0.01 + PARAMETERS.floor_clearance)
    observation = seen(table=0.01, pick=0.021)
    run = Run(World(touch_place=NO_TOUCH), observation=observation).until(Mode.RELEASE)
    assert run.output("desired_motion")[2] == pytest.approx(0.01 + PARAMETERS.floor_clearance)


@pytest.mark.parametrize("tallest", [0.05, 0.16])
def test_travel_clears_the_highest_surface(tallest: float):
    """In the last two centimetres of a travel, only the surfaces at the goal must be cleared."""
    run = Run(observation=seen(pick=0.06, place=0.03, tallest=tallest), is_logged=True).finish()
    q = run.log.FindLog(run.simulator.get_context()).data()[:3]
    times = run.log.FindLog(run.simulator.get_context()).sample_times()
    begins = {mode: time for time, mode in reversed(run.modes)}
    hanging = 0.06 - PARAMETERS.grasp_depth

    def lowest(mode: Mode, before: PlanarPose | None, after: PlanarPose | None) -> float:
        """The lowest fingertip height in a mode, away from the poses where it starts and ends."""
        during = (times >= begins[mode]) & (times < begins[Mode((mode + 1) % Mode.DONE)])
        for pose in (before, after):
            if pose is not None:
                during &= np.hypot(q[0] - pose.x, q[1] - pose.y) > 0.025
        return float(q[2, during].min())

    free = tallest + PARAMETERS.travel_clearance - 1e-3
    assert lowest(Mode.APPROACH, None, PICK) >= free
    assert lowest(Mode.CARRY, PICK, PLACE) >= free + hanging
    hover = PARAMETERS.hover_clearance
    at_pick, at_place = (
        float(np.interp(begins[mode], times, q[2])) for mode in (Mode.DESCEND, Mode.LOWER)
    )
    assert at_pick == pytest.approx(0.06 + hover, abs=1e-4)
    assert at_place == pytest.approx(0.03 + hanging + hover, abs=1e-4)


@pytest.mark.parametrize("higher", [0.0, 0.006, 0.012])
def test_an_object_gripped_higher_than_planned_clears_the_rim(higher: float):
    """After an early contact, more of the object hangs below the hand than o_t predicted."""
    world = World(touch_pick=GRASP_Z + higher if higher else NO_TOUCH)
    seen_heights = dataclasses.replace(HEIGHTS, near_place=0.05, place_rim=0.05)
    run = Run(world, answer=dataclasses.replace(ACTION, heights=seen_heights)).until(Mode.LIFT)
    hanging = run.output("desired_motion")[2]
    run.until(Mode.LOWER)
    bottom = run.output("desired_motion")[2] - hanging
    assert bottom >= 0.05 + PARAMETERS.hover_clearance - 5e-4


@pytest.mark.parametrize(("leaves", "hangs"), [(0.003, 0.0), (0.03, 0.045), (0.06, 0.09)])
def test_an_object_that_leaves_the_table_late_hangs_lower_and_is_carried_higher(
    leaves: float, hangs: float
):
    usual, late = (
        Run(World(leaves=z), parameters=LIGHT).until(Mode.LOWER) for z in (0.001, leaves)
    )
    higher = late.output("desired_motion")[2] - usual.output("desired_motion")[2]
    assert hangs - 0.002 < higher < hangs + 0.015


@pytest.mark.parametrize("ramp", [0.05, 0.4])
def test_the_closing_force_is_continuous_up_to_a_firm_grip(ramp: float):
    parameters = dataclasses.replace(
        PARAMETERS,
        force_ramp=ramp,
        heavy_load=WEIGHT - 0.5,
        peak_grasp_force=PARAMETERS.firm_grasp_force,
    )
    run = Run(parameters=parameters).until(Mode.CHECK)
    forces, step = [run.output("closing_force")[0]], ramp / 16
    while run.sequence[-1] != Mode.RELEASE:
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + step)
        forces.append(run.output("closing_force")[0])
    assert max(forces) == parameters.firm_grasp_force
    steepest = parameters.firm_grasp_force / ramp * step
    assert np.abs(np.diff(forces[:-1])).max() <= steepest + 1e-6


def test_the_hand_rises_before_it_leaves_the_place():
    run = Run(observation=seen(pick=0.06, tallest=0.16)).until(Mode.RETREAT)
    while run.sequence[-1] == Mode.RETREAT:
        x, y, z = run.output("desired_motion")[:3]
        assert y == pytest.approx(PLACE.y)
        assert z >= 0.16 or x == pytest.approx(PLACE.x)
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)


def test_an_action_without_heights_needs_an_observation():
    run = Run(answer=PickPlaceAction(PICK, PLACE))
    with pytest.raises(RuntimeError, match="observation"):
        run.simulator.AdvanceTo(2.0)


def test_descent_stops_at_contact():
    touched = GRASP_Z + 0.02
    run = Run(World(touch_pick=touched)).until(Mode.CLOSE)
    z = run.output("desired_motion")[2]
    late = PARAMETERS.descend_speed / 64
    assert touched - late < z <= touched
    # The hand backs off, because the jaws cannot close while the fingertips press on something.
    backed_off = run.until(Mode.CHECK).output("desired_motion")[2]
    assert backed_off == pytest.approx(z + PARAMETERS.floor_clearance, abs=2e-4)


@pytest.mark.parametrize(("height", "depth"), [(0.02, 0.010), (0.04, 0.016), (0.09, 0.018)])
def test_tall_objects_are_gripped_deeper(height: float, depth: float):
    heights = SurfaceHeights(pick_top=0.03 + height, support=0.03)
    answer = dataclasses.replace(ACTION, heights=heights)
    run = Run(answer=answer, parameters=PickPlaceParameters()).until(Mode.CLOSE)
    assert run.output("desired_motion")[2] == pytest.approx(0.03 + height - depth)


def test_descent_to_a_flat_object_stays_above_the_table():
    flat = dataclasses.replace(PARAMETERS, grasp_depth=0.05)
    run = Run(parameters=flat).until(Mode.CLOSE)
    assert run.output("desired_motion")[2] == pytest.approx(PARAMETERS.floor_clearance)


def test_a_missed_grasp_is_counted_and_retried():
    world = World(width=lambda attempt, mode: 0.0 if attempt == 1 else WIDTH)
    run = Run(world, actions=2).finish()
    missed = [*PICK_AND_PLACE[: PICK_AND_PLACE.index(Mode.CHECK) + 1], Mode.RETREAT]
    assert run.sequence == [*missed, *PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]
    assert run.counts == [2, 1, 0]
    assert run.output("failed_picks") == (PICK,)


def test_the_latest_failed_picks_are_remembered():
    """The port has room for 16 picks, which it holds in their order."""
    world = World(width=lambda attempt, mode: 0.0)
    run = Run(world, actions=18, parameters=dataclasses.replace(PARAMETERS, max_actions=18))
    picks = [dataclasses.replace(PICK, x=0.3 + 0.01 * number) for number in range(18)]
    run.policy.answers = [dataclasses.replace(ACTION, pick=pick) for pick in picks]
    assert run.finish().counts == [18, 18, 0]
    assert run.output("failed_picks") == tuple(picks[-16:])


@pytest.mark.parametrize(
    ("name", "x", "message"),
    [
        ("pick", np.nan, "pick .*finite"),
        ("place", 50.0, "place .*x is 50"),
    ],
)
def test_an_action_out_of_reach_raises(name: str, x: float, message: str):
    pose = dataclasses.replace(PLACE, x=x)
    run = Run(answer=dataclasses.replace(ACTION, **{name: pose}))
    with pytest.raises(RuntimeError, match=message):
        run.simulator.AdvanceTo(2.0)


def test_a_press_ignores_the_place():
    nowhere = PlanarPose(np.nan, np.nan, np.nan)
    answer = dataclasses.replace(ACTION, press=True, place=nowhere)
    assert Run(answer=answer).finish().counts == [1, 0, 0]


def test_an_object_dropped_while_searching_is_counted():
    def width(attempt: int, mode: Mode) -> float:
        return 0.0 if attempt == 1 and mode == Mode.SEARCH else WIDTH

    world = World(touch_place=ON_THE_RIM, width=width)
    run = Run(world, answer=OVER_A_CAVITY, insertion=True).until(Mode.RETREAT)
    assert run.sequence[-2:] == [Mode.SEARCH, Mode.RETREAT]
    # It lies at its place, where the policy must look for it.
    assert [item.outcome for item in run.output("history")] == ["placed"]
    assert run.finish().counts == [1, 0, 1]


@pytest.mark.parametrize(("force", "layings"), [(-2.0, 2), (-0.3, 0)])
def test_the_hand_goes_down_again_if_an_object_hangs_on_it(force: float, layings: int):
    """It does so twice at most, because a sensor may be wrong."""
    run = Run(Jam(mode=Mode.RETREAT, force=(0.0, 0.0, force))).finish()
    again = [Mode.RELEASE, Mode.LOWER, Mode.RELEASE, Mode.RETREAT]
    assert run.sequence == [*PICK_AND_PLACE, *layings * again, Mode.OBSERVE, Mode.DONE]
    assert [item.outcome for item in run.output("history")] == ["placed"]
    assert run.counts == [1, 0, 0]


def test_a_hanging_object_is_lowered_slowly_from_the_start():
    """It may hang by any length, so it may touch the ground at once."""
    run = Run(Jam(mode=Mode.RETREAT, force=(0.0, 0.0, -2.0)), is_logged=True).finish()
    layings = [i for i, (_, mode) in enumerate(run.modes) if mode == Mode.LOWER][1:]
    log = run.log.FindLog(run.simulator.get_context())
    for i in layings:
        inside = (log.sample_times() > run.modes[i][0]) & (log.sample_times() < run.modes[i + 1][0])
        z, times = log.data()[2, inside], log.sample_times()[inside]
        assert np.ptp(z) > 0.02
        assert np.abs(np.diff(z) / np.diff(times)).max() < 1.05 * PARAMETERS.contact_speed


def test_jaws_that_lay_an_object_down_open_fully_and_then_close_half_of_the_way():
    run = Run(Jam(mode=Mode.RETREAT, force=(0.0, 0.0, -2.0)))
    retreats = []
    while len(retreats) < 3:
        run.until(Mode.RETREAT)
        retreats.append(run.output("desired_opening")[0])
        run.until(Mode.RELEASE if len(retreats) < 3 else Mode.OBSERVE)
    assert retreats[1] == pytest.approx(PARAMETERS.open_width, abs=1e-3)
    assert retreats[2] == pytest.approx(PARAMETERS.open_width / 2, abs=1e-3)


@pytest.mark.parametrize("press", [False, True])
def test_the_hand_does_not_go_down_again_after_a_stop_or_a_press(press: bool):
    pulled = Jam(mode=Mode.RETREAT, force=(0.0, 0.0, -2.0))
    if press:
        run = Run(pulled, answer=dataclasses.replace(ACTION, press=True)).finish()
    else:
        parameters = dataclasses.replace(PARAMETERS, force_limit=1.5)
        run = Run(pulled, parameters=parameters).finish()
        assert [item.outcome for item in run.output("history")] == ["stopped"]
    assert run.sequence.count(Mode.LOWER) == (0 if press else 1)


@pytest.mark.parametrize("where", [Mode.LIFT, Mode.CARRY, Mode.LOWER])
def test_a_dropped_object_is_counted_and_retried(where: Mode):
    def width(attempt: int, mode: Mode) -> float:
        return 0.0 if attempt == 1 and mode >= where else WIDTH

    run = Run(World(width=width), actions=2).finish()
    dropped = [*PICK_AND_PLACE[: PICK_AND_PLACE.index(where) + 1], Mode.RETREAT]
    assert run.sequence == [*dropped, *PICK_AND_PLACE, Mode.OBSERVE, Mode.DONE]
    assert run.counts == [2, 0, 1]


@pytest.mark.parametrize(
    ("speed", "levers", "is_lost"),
    [
        (0.15, (), True),
        (0.05, (), False),
        # In a trial lift.
        (0.15, (0.04,), True),
    ],
)
def test_pads_that_slip_off_the_lifted_object_let_go(speed: float, levers: tuple, is_lost: bool):
    run = Run(World(slips=speed, levers=levers), actions=2).finish()
    assert run.counts == [2, 0, float(is_lost)]
    assert (Mode.CARRY in run.sequence[: run.sequence.index(Mode.RETREAT)]) == (not is_lost)


def test_a_hand_that_sinks_stops_at_once_when_the_object_is_lost():
    held = [True]
    run = Run(World(width=lambda attempt, mode: WIDTH if held[0] else 0.0)).until(Mode.LOWER)
    while run.output("desired_motion")[6] > -0.1:
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
    held[0] = False
    lowest = run.until(Mode.RETREAT).output("desired_motion")[2]
    for _ in range(8):
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
        assert run.output("desired_motion")[2] >= lowest


def test_max_actions():
    parameters = dataclasses.replace(PARAMETERS, max_actions=2)
    run = Run(World(width=lambda attempt, mode: 0.0), actions=100, parameters=parameters).finish()
    assert run.counts == [2, 2, 0]
    assert len(run.policy.asked) == 2  # A third action would be ignored, so it is not requested.


def test_the_policy_is_asked_only_at_the_end_of_observing():
    run = Run(actions=2).finish()
    ends = [end for (_, mode), (end, _) in itertools.pairwise(run.modes) if mode == Mode.OBSERVE]
    assert len(run.policy.asked) == 3
    np.testing.assert_allclose(run.policy.asked, ends, atol=1 / 64)
    assert run.policy.asked[0] >= PARAMETERS.observe_settle


FAR = PickPlaceAction(PlanarPose(0.35, 0.45, 0.1), PlanarPose(0.7, -0.45, -0.3), heights=HEIGHTS)
TURN = PickPlaceAction(PlanarPose(0.5, 0.02, -1.4), PlanarPose(0.5, -0.02, 1.4), heights=HEIGHTS)


@pytest.mark.parametrize("answer", [FAR, TURN], ids=["far", "turn"])
def test_motion_is_smooth_and_within_the_limits_of_its_mode(answer: PickPlaceAction):
    p = PARAMETERS
    speeds = dict.fromkeys(Mode, p.linear_speed)
    speeds |= {Mode.LIFT: p.carry_speed, Mode.CARRY: p.carry_speed}
    speeds |= {Mode.DESCEND: p.descend_speed, Mode.LOWER: p.lower_speed}
    accelerations = dict.fromkeys(Mode, p.linear_acceleration)
    accelerations |= dict.fromkeys((Mode.LIFT, Mode.CARRY, Mode.LOWER), p.carry_acceleration)
    run = Run(answer=answer, parameters=LIGHT)
    step = 1 / 512
    times, samples, modes = [], [], []
    while not samples or modes[-1] != Mode.DONE:
        times.append(len(times) * step)
        run.simulator.AdvanceTo(times[-1])
        samples.append(run.output("desired_motion").copy())
        modes.append(Mode(int(run.output("mode")[0])))
    fastest: dict[Mode, float] = {}
    turning = 0.0
    for before, after, mode, next_mode in zip(samples, samples[1:], modes, modes[1:], strict=False):
        if mode != next_mode:
            continue
        _, v, a = np.split(after, 3)
        difference = (after - before) / step
        mean_v, mean_a = (before[4:8] + v) / 2, (before[8:12] + a) / 2
        np.testing.assert_allclose(difference[:4], mean_v, atol=1e-3)
        np.testing.assert_allclose(difference[4:8], mean_a, atol=0.3)
        for part in (slice(0, 2), slice(2, 3)):  # Horizontally, then vertically.
            speed, acceleration = np.linalg.norm(v[part]), np.linalg.norm(a[part])
            assert speed <= speeds[mode] * 1.0001, mode
            assert acceleration <= accelerations[mode] * 1.0001, mode
            fastest[mode] = max(fastest.get(mode, 0.0), speed)
        # Limits of the combined horizontal and vertical motion.
        assert np.linalg.norm(v[:3]) <= 1.7
        assert np.linalg.norm(a[:3]) <= 13.0
        assert abs(v[3]) <= p.yaw_speed * 1.0001
        assert abs(a[3]) <= p.yaw_acceleration * 1.0001
        turning = max(turning, abs(v[3]))
    # LOWER begins faster than `contact_speed`. The long carry and the long turn reach their limits.
    assert fastest[Mode.LOWER] > 1.2 * p.contact_speed
    if answer is FAR:
        assert fastest[Mode.CARRY] == pytest.approx(p.carry_speed, rel=1e-2)
    else:
        assert turning == pytest.approx(p.yaw_speed, rel=1e-2)


def test_reset_and_rerun_give_equal_logs():
    run = Run(is_logged=True).finish()
    context = run.simulator.get_mutable_context()
    first = run.log.FindLog(context).data().copy()
    counts, modes = run.counts, run.modes
    assert first.shape[1] > 100
    run.log.FindMutableLog(context).Clear()
    context.SetTime(0.0)
    run.diagram.SetDefaultContext(context)
    run.policy.asked.clear()
    run.modes = []
    run.simulator.Initialize()
    run.finish()
    np.testing.assert_array_equal(run.log.FindLog(context).data(), first)
    assert (run.counts, run.modes) == (counts, modes)


def test_an_object_is_pressed_down_with_closed_jaws():
    answer = dataclasses.replace(ACTION, press=True)
    run = Run(World(touch_pick=0.047, stiffness=1e4), answer=answer, actions=1)
    run.until(Mode.DESCEND)
    assert run.output("desired_opening")[0] == pytest.approx(0.0, abs=1e-3)
    run.until(Mode.RETREAT)
    assert run.sequence == [Mode.OBSERVE, Mode.APPROACH, Mode.DESCEND, Mode.RETREAT]
    # At 10 kN/m, 26 N are reached 2.6 mm deep. The press stops at most one period later.
    z = run.output("desired_motion")[2]
    assert z == pytest.approx(0.047 - 0.0026, abs=PARAMETERS.touch_speed / 64 + 1e-4)
    assert run.finish().counts == [1, 0, 0]
    assert run.output("failed_picks") == (PICK,)


def test_a_press_without_contact_ends_at_its_depth():
    run = Run(answer=dataclasses.replace(ACTION, press=True), actions=1).until(Mode.RETREAT)
    z = run.output("desired_motion")[2]
    assert z == pytest.approx(HEIGHTS.pick_top - PARAMETERS.press_depth, abs=2e-3)


def test_a_press_touches_a_rim_beside_the_object_slowly():
    heights = dataclasses.replace(HEIGHTS, near_pick=0.056)
    answer = dataclasses.replace(ACTION, press=True, heights=heights)
    run = Run(World(touch_pick=0.056, stiffness=1e4), answer=answer).until(Mode.DESCEND)
    while run.output("desired_motion")[2] > 0.056:
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
    assert 0 < -run.output("desired_motion")[6] <= PARAMETERS.touch_speed + 1e-6


GUARDED = dataclasses.replace(PARAMETERS, force_limit=30.0)
SOFT = 2000.0
LATERAL, PUSH = (0.0, 31.0, 0.0), (0.0, 0.0, 31.0)


@pytest.mark.parametrize(
    ("mode", "force"),
    [
        (Mode.APPROACH, PUSH),
        (Mode.APPROACH, LATERAL),
        (Mode.DESCEND, LATERAL),
        (Mode.CLOSE, PUSH),
        (Mode.CHECK, LATERAL),
        (Mode.LIFT, LATERAL),
        (Mode.CARRY, LATERAL),
        (Mode.LOWER, LATERAL),
        (Mode.RELEASE, LATERAL),
        (Mode.RETREAT, (0.0, 0.0, -31.0 - WEIGHT)),
    ],
)
def test_a_contact_force_beyond_the_limit_stops_the_action(mode: Mode, force: tuple):
    run = Run(Jam(mode=mode, force=force, stiffness=SOFT), parameters=GUARDED).finish()
    after = run.sequence[run.sequence.index(mode) + 1 :]
    holds = Mode.CHECK <= mode < Mode.RELEASE
    assert after[:2] == [Mode.RELEASE, Mode.RETREAT] if holds else Mode.RETREAT in [mode, after[0]]
    assert run.output("counts").tolist() == [1, 0, 0, 1]
    (attempt,) = run.output("history")
    assert (attempt.outcome, attempt.action.pick) == ("stopped", PICK)
    # The mean over 1/64 s: the force grows until the hand stops.
    assert 15.0 < attempt.peak_force < 37.5
    vertical, lateral, where = run.output("peak_force")
    assert Mode(int(where)) == mode
    assert max(vertical, lateral) == attempt.peak_force
    assert run.output("failed_picks") == (PICK,)


@pytest.mark.parametrize(("force", "rise"), [(PUSH, 0.005), (LATERAL, 0.0)])
def test_a_hand_that_is_pushed_up_rises_while_it_lets_go(force: tuple, rise: float):
    run = Run(Jam(mode=Mode.CHECK, force=force, stiffness=SOFT), parameters=GUARDED)
    before = run.until(Mode.RELEASE).output("desired_motion")[2]
    assert run.until(Mode.RETREAT).output("desired_motion")[2] - before == pytest.approx(
        rise, abs=1e-3
    )


@pytest.mark.parametrize("force", [(0.0, 29.0, 0.0), (0.0, 0.0, 0.0)])
def test_the_guard_lets_a_smaller_force_pass(force: tuple):
    run = Run(Jam(mode=Mode.CARRY, force=force, stiffness=SOFT), parameters=GUARDED).finish()
    assert run.counts == [1, 0, 0]
    (attempt,) = run.output("history")
    assert (attempt.outcome, attempt.action.place.x) == ("placed", PLACE.x)
    assert run.output("failed_picks") == ()


def test_a_load_pressed_at_the_end_of_a_carry_is_no_payload():
    """An object that touches something too early is released at once, not pressed down further."""
    touched = HANGING + GUARDED.hover_clearance + 0.002
    run = Run(World(touch_place=touched, stiffness=SOFT), parameters=GUARDED).until(Mode.RELEASE)
    assert run.output("desired_motion")[2] == pytest.approx(touched - 0.002, abs=1e-3)
    # Pressing 2 mm deep at 2 kN/m takes 4 N. The payload does not count.
    assert run.output("peak_force")[0] == pytest.approx(4.0, abs=0.5)


def test_what_a_stopping_policy_left_over_is_kept():
    run = Run(actions=1)
    points = tuple((0.3 + 0.001 * number, 0.1) for number in range(30))
    report = LeftOver(objects=points, cavities=((0.5, -0.2),))
    stop = PickPlaceAction(stop=True, reason="nothing fits", left_over=report)
    run.policy.answers.append(stop)
    accepted = run.finish().output("accepted_action")
    assert (accepted.stop, accepted.reason) == (True, "nothing fits")
    assert accepted.left_over == LeftOver(points[:24], report.cavities)


def test_a_policy_that_reports_nothing_leaves_no_report():
    assert Run().finish().output("accepted_action").left_over is None


def test_the_history_tells_how_high_a_seated_object_would_be():
    heights = dataclasses.replace(HEIGHTS, support=0.01, place_floor=0.02)
    (attempt,) = Run(answer=dataclasses.replace(ACTION, heights=heights)).finish().output("history")
    assert attempt.top == pytest.approx(0.02 + 0.05 - 0.01)


def test_aside_is_part_of_the_history():
    run = Run(answer=dataclasses.replace(ACTION, aside=True)).finish()
    assert [attempt.action.aside for attempt in run.output("history")] == [True]
    assert [attempt.outcome for attempt in run.output("history")] == ["placed"]


def test_the_hand_slows_down_where_contact_is_expected():
    heights = dataclasses.replace(HEIGHTS, place_rim=0.03, near_place=0.03, place_floor=0.02)
    run = Run(answer=dataclasses.replace(ACTION, heights=heights)).until(Mode.LOWER)
    speeds: dict[float, float] = {}
    while run.sequence[-1] == Mode.LOWER:
        z, vz = run.output("desired_motion")[[2, 6]]
        speeds[round(1e3 * (z - HANGING - 0.02), 2)] = -vz
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
    slow = {above: speed for above, speed in speeds.items() if above < 1e3 * PARAMETERS.slow_margin}
    on_the_way = [speed for above, speed in speeds.items() if 2.5 < above < 11.5]
    assert max(slow.values()) <= PARAMETERS.touch_speed + 1e-6
    assert max(on_the_way) <= PARAMETERS.contact_speed + 1e-6
    assert max(speeds.values()) > 2 * PARAMETERS.contact_speed


def test_what_is_laid_aside_is_lowered_slowly_from_higher_up():
    heights = dataclasses.replace(HEIGHTS, highest=0.2)
    starts = {}
    for aside in (False, True):
        answer = dataclasses.replace(ACTION, heights=heights, aside=aside)
        run = Run(answer=answer).until(Mode.LOWER)
        starts[aside] = run.output("desired_motion")[2]
    assert starts[True] == pytest.approx(starts[False] + 0.05, abs=1e-3)
    slow = []
    while run.sequence[-1] == Mode.LOWER:
        z, vz = run.output("desired_motion")[[2, 6]]
        slow += [-vz] if z < starts[True] - PARAMETERS.hover_clearance else []
        run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
    assert len(slow) > 50
    assert max(slow) <= PARAMETERS.contact_speed + 1e-6


def test_what_is_laid_aside_is_lifted_slowly():
    """It may turn in the jaws and hit what lies around it."""
    fastest = {}
    for aside in (False, True):
        run = Run(answer=dataclasses.replace(ACTION, aside=aside)).until(Mode.LIFT)
        speeds = []
        while run.sequence[-1] == Mode.LIFT:
            speeds.append(run.output("desired_motion")[6])
            run.simulator.AdvanceTo(run.simulator.get_context().get_time() + 1 / 128)
        fastest[aside] = max(speeds)
    assert fastest[True] <= 0.25 + 1e-6 < fastest[False]


@pytest.mark.parametrize(("force", "lets_go"), [(25.0, True), (15.0, False)])
def test_jaws_that_grip_something_fixed_let_go(force: float, lets_go: bool):
    jam = Jam(mode=Mode.CHECK, force=(0.0, force, 0.0), stiffness=SOFT)
    run = Run(jam, parameters=GUARDED).finish()
    after = run.sequence[run.sequence.index(Mode.CHECK) + 1]
    assert after == (Mode.RELEASE if lets_go else Mode.LIFT)
    (attempt,) = run.output("history")
    assert attempt.outcome == ("stopped" if lets_go else "placed")
    assert run.output("counts").tolist() == [1, 0, 0, float(lets_go)]
