import math

import numpy as np
import pytest
from numpy.typing import NDArray

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.robot import arm_model
from systems.arm_collisions import Capsule
from systems.arm_inertia import ArmInertia
from systems.arm_kinematics import ArmBase, fingertips, hand_state, joint_frames
from systems.arm_limits import ARM_LIMITS, FR3, PANDA, ArmLimits
from systems.arm_motion import ArmMotion, ArmState
from systems.arm_postures import ArmPostures, HandStop
from systems.arm_reach import reach_problem
from systems.pick_place_parameters import Mode, PickPlaceParameters

BASE = ArmBase(0.1, 0.0, 0.0)
PARAMETERS = PickPlaceParameters()
WAYS = (Mode.APPROACH, Mode.DESCEND, Mode.LIFT, Mode.LOWER, Mode.SEARCH, Mode.RETREAT)
HIGHEST = 0.05


def motion_of(
    limits: ArmLimits = FR3,
    obstacles: tuple[Capsule, ...] = (),
    inertia: ArmInertia | None = None,
) -> ArmMotion:
    return ArmMotion(PARAMETERS, limits, BASE, obstacles, inertia=inertia)


def set_action(state: ArmState, pick: tuple, place: tuple) -> None:
    """Sets an action that brings a tool, 25 mm high, from the table into a kit, 50 mm high."""
    state.pick, state.place = pick, place
    state.grasp_z, state.pick_top_z, state.table_z = 0.015, 0.025, 0.0
    state.clear_z = HIGHEST + PARAMETERS.travel_clearance
    state.travel_z = state.clear_z + 0.015
    state.pick_hover_z, state.place_hover_z = 0.035, 0.075
    state.floor_z, state.rim_z, state.hold_z, state.touch_z = 0.02, 0.05, 0.015, 0.06


def random_action(rng: np.random.Generator) -> tuple[tuple, tuple]:
    pick = (rng.uniform(0.3, 0.68), rng.uniform(0.0, 0.4), rng.uniform(-math.pi, math.pi))
    place = (rng.uniform(0.35, 0.65), rng.uniform(-0.38, 0), rng.uniform(-math.pi, math.pi))
    return pick, place


def states(motion: ArmMotion, state: ArmState, start: float, end: float) -> NDArray:
    """The motion at every millisecond, as an array (n, 21)."""
    times = start + np.arange(math.ceil(1000 * (end - start))) / 1000
    return np.array([motion.motion_at(state, time) for time in times])


def check_limits(limits: ArmLimits, samples: NDArray, inertia: ArmInertia) -> None:
    """Checks every limit, and that velocities and accelerations are the positions' derivatives."""
    q, v, a = np.split(samples, 3, axis=1)
    low, high = limits.velocity_bounds(q)
    assert (q >= limits.lower).all()
    assert (q <= limits.upper).all()
    assert (v >= low).all()
    assert (v <= high).all()
    assert (np.abs(a) <= limits.acceleration).all()
    jerk = np.diff(a, axis=0) / 1e-3
    assert (np.abs(jerk) <= limits.jerk).all()
    torques = np.array([inertia.mass(*it) for it in zip(q, strict=True)])
    torques = np.einsum("nij,nj->ni", torques, a)
    assert (np.abs(torques) <= limits.torque).all()
    assert (np.abs(np.diff(torques, axis=0)) / 1e-3 <= limits.torque_rate).all()
    # Allow for the jerk between two samples, which makes differences deviate from derivatives.
    allowed = 1e-3 * np.array(limits.jerk) * 1e-3 / 2
    assert (np.abs(np.diff(v, axis=0) / 1e-3 - a[:-1]) <= 1e-3 * np.array(limits.jerk)).all()
    assert (np.abs(np.diff(q, axis=0) / 1e-3 - (v[:-1] + v[1:]) / 2) <= allowed).all()


def check_random_ways(model: str, actions: int, seed: int) -> int:
    """Checks the limits in all motions of random actions, some of them cut short by a stop.

    Returns:
        The number of motions.
    """
    limits, rng = ARM_LIMITS[model], np.random.default_rng(seed)
    inertia = ArmInertia(arm_model(FrankaArm(model=model))[0])
    motion, time, ways = ArmMotion(PARAMETERS, limits, BASE, inertia=inertia), 1.0, 0
    state = motion.view(motion.initial_state())
    samples = [motion.motion_at(state, time)[None]]
    for _ in range(actions):
        set_action(state, *random_action(rng))
        if not motion.prepare(state):
            continue
        for mode in WAYS:
            motion.begin(state, mode, time)
            lasts = motion.arrival(state) - time
            ways += 1
            if rng.random() < 0.3:
                # Release the object on the way.
                later = time + rng.uniform(0.0, lasts)
                samples.append(states(motion, state, time, later))
                hand = motion.postures.hand_pose(motion.motion_at(state, later)[:7])
                motion.begin(state, Mode.RELEASE, later, z=float(hand[2]))
                time, lasts, ways = later, motion.arrival(state) - later, ways + 1
            samples.append(states(motion, state, time, time + lasts))
            time += lasts
            at_rest = motion.motion_at(state, time)
            np.testing.assert_allclose(at_rest[7:], 0.0, atol=1e-12)
    # Samples are 1 ms apart within a motion, but not from one motion to the next. So check each
    # motion separately.
    for part in samples:
        if len(part) > 2:
            check_limits(limits, part, inertia)
    return ways


@pytest.mark.parametrize("model", ["fr3", pytest.param("panda", marks=pytest.mark.slow)])
def test_all_limits_hold_at_every_millisecond_also_when_stopped(model: str):
    assert check_random_ways(model, actions=3, seed=3) > 10


@pytest.mark.slow
@pytest.mark.parametrize("model", ["fr3", "panda"])
def test_all_limits_hold_on_hundreds_of_ways(model: str):
    assert check_random_ways(model, actions=60, seed=4) > 300


def test_a_stop_is_continuous_and_short():
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, (0.6, 0.3, 0.4), (0.5, -0.3, 0.0))
    assert motion.prepare(state)
    motion.begin(state, Mode.APPROACH, 0.0)
    middle = motion.arrival(state) / 2
    before = motion.motion_at(state, middle)
    assert np.abs(before[7:14]).max() > 0.5
    motion.begin(state, Mode.RELEASE, middle)
    np.testing.assert_array_equal(motion.motion_at(state, middle), before)
    assert state.duration < 0.35


def test_the_hand_s_acceleration_is_that_of_the_joints():
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, (0.6, 0.3, 0.4), (0.5, -0.3, 0.0))
    assert motion.prepare(state)
    motion.begin(state, Mode.APPROACH, 0.0)
    motion.begin(state, Mode.RETREAT, 0.3)
    for time in (0.32, 0.45, 0.6):
        step = 2e-3
        tips = [
            BASE.to_world(fingertips(motion.motion_at(state, time + i * step)[:7]))
            for i in (-1, 0, 1)
        ]
        expected = (tips[0] - 2 * tips[1] + tips[2]) / step**2
        found = motion.hand_acceleration(state, time, motion.motion_at(state, time))
        np.testing.assert_allclose(found, expected, atol=1.5)


@pytest.mark.parametrize(
    ("pick", "place", "tilts"),
    [
        ((0.39, 0.31, 1.44), (0.37, -0.13, 1.48), False),
        # Here the hand must also tilt during LIFT, by up to 46 degrees.
        ((0.348, 0.008, 1.396), (0.719, -0.166, -1.358), True),
        # Here the fastest postures would let the hand sink on its way to the pick, by 29 mm.
        ((0.353, 0.092, -1.855), (0.641, -0.204, 0.446), True),
    ],
)
def test_where_the_arm_leaves_its_vertical_plane_the_hand_clears_everything(
    pick: tuple, place: tuple, tilts: bool
):
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, pick, place)
    assert motion.prepare(state)
    assert max(abs(state.pick_joints[2]), abs(state.place_joints[2])) > 0.1
    time = 0.0
    for mode in (Mode.APPROACH, Mode.DESCEND, Mode.LIFT, Mode.LOWER, Mode.RETREAT):
        motion.begin(state, mode, time)
        q = states(motion, state, time, motion.arrival(state))[:, :7]
        time = motion.arrival(state)
        if mode in (Mode.DESCEND, Mode.LOWER):
            continue
        down = joint_frames(q)[0][:, 7, 2, 2]
        tips = BASE.to_world(fingertips(q))
        away = np.linalg.norm(tips[:, :2] - tips[0, :2], axis=1) > 0.007
        near = np.linalg.norm(tips[:, :2] - tips[-1, :2], axis=1) < 0.021
        # `reach` is half the length of a carried object of 0.2 m, or of the open jaws.
        reach, clear = (0.1, state.travel_z) if mode == Mode.LIFT else (0.04, state.clear_z)
        lowest = tips[:, 2] - reach * np.sqrt(np.maximum(1 - down**2, 0))
        assert lowest[away & ~near].min() > clear - 0.004
        if mode == Mode.LIFT and not tilts:
            assert down.max() < -math.cos(math.radians(3.0))


@pytest.mark.parametrize("has_inertia", [False, True])
def test_the_hand_follows_its_heights(has_inertia: bool):
    inertia = ArmInertia(arm_model(FrankaArm())[0]) if has_inertia else None
    motion = motion_of(inertia=inertia)
    state = motion.view(motion.initial_state())
    set_action(state, (0.6, 0.3, 0.4), (0.5, -0.3, 2.0))
    assert motion.prepare(state)
    time = 0.0
    tips, downs = {}, {}
    for mode in (Mode.APPROACH, Mode.DESCEND, Mode.LIFT, Mode.LOWER):
        motion.begin(state, mode, time)
        q = states(motion, state, time, motion.arrival(state))[:, :7]
        tips[mode] = BASE.to_world(fingertips(q))
        downs[mode] = joint_frames(q)[0][:, 7, 2, 2]
        time = motion.arrival(state)
    hand = motion.postures.hand_pose(motion.motion_at(state, time)[:7])
    np.testing.assert_allclose(hand[:3], [0.5, -0.3, PARAMETERS.floor_clearance], atol=1e-6)
    turn = math.remainder(float(hand[3]) - 2.0, math.pi)
    assert abs(turn) < 1e-6
    # In all motions the hand points down.
    assert max(down.max() for down in downs.values()) < -0.9999
    lift = tips[Mode.LIFT]
    away = np.linalg.norm(lift[:, :2] - (0.6, 0.3), axis=1)
    near = np.linalg.norm(lift[:, :2] - (0.5, -0.3), axis=1)
    # The path's corners are rounded off, so the path may be a little too low near them.
    assert lift[(away > 0.007) & (near > 0.021), 2].min() > state.travel_z - 0.004
    assert lift[-1, 2] == pytest.approx(state.place_hover_z)
    for mode, goal in ((Mode.DESCEND, (0.6, 0.3)), (Mode.LOWER, (0.5, -0.3))):
        assert np.abs(tips[mode][:, :2] - goal).max() < 1e-4
    # Where the object may touch something, the hand is as slow as a floating hand.
    slow = tips[Mode.LOWER][tips[Mode.LOWER][:, 2] < 0.049, 2]
    assert np.abs(np.diff(slow) / 1e-3).max() <= 1.05 * PARAMETERS.touch_speed


def test_equal_states_give_equal_motions_in_any_order():
    first, second = motion_of(), motion_of()
    seen = []
    for motion in (first, second):
        state = motion.view(motion.initial_state())
        set_action(state, (0.6, 0.3, 0.4), (0.5, -0.3, 2.0))
        motion.prepare(state)
        motion.begin(state, Mode.APPROACH, 0.0)
        motion.begin(state, Mode.RETREAT, 0.3)
        seen.append(state)
    np.testing.assert_array_equal(seen[0].vector, seen[1].vector)
    backwards = [second.motion_at(seen[1], t) for t in (0.9, 0.5, 0.31)]
    forwards = [first.motion_at(seen[0], t) for t in (0.31, 0.5, 0.9)]
    np.testing.assert_array_equal(backwards[::-1], forwards)


def test_joint_seven_stays_in_its_range_for_every_turn_of_an_object():
    for limits in (FR3, PANDA):
        motion = motion_of(limits)
        state = motion.view(motion.initial_state())
        for pick_yaw in (-2.3, 0.8):
            for turn in np.linspace(-3.1, 3.1, 5):
                set_action(state, (0.5, 0.2, pick_yaw), (0.5, -0.2, pick_yaw + turn))
                assert motion.prepare(state), motion.reach_problem(state)
                turned = state.place[2] - state.pick[2]
                assert abs(math.remainder(turned - turn, math.tau)) < 1e-9


def test_what_cannot_be_reached_is_said():
    postures = ArmPostures(FR3, BASE)

    def problem(x: float, y: float, **kwargs) -> str:
        stop = HandStop("the pick", x, y, 0.3, **({"low": 0.02, "high": 0.1} | kwargs), surface=0.0)
        return reach_problem(postures, [stop])

    assert problem(0.5, 0.2) == ""
    assert "out of the arm's reach" in problem(0.95, 0.3)
    assert "out of the arm's reach" in problem(0.5, 0.0, high=1.2)
    # If the hand reaches 0.2 m below the surface around it, the forearm collides with the surface.
    deep = HandStop("the place", 0.5, 0.2, 0.3, low=-0.2, high=0.1, surface=0.0)
    assert "collide" in reach_problem(postures, [deep])
    post = Capsule((0.6, 0.0, -0.5), (0.6, 0.0, 0.3), 0.02)
    motion = motion_of(obstacles=(post,))
    state = motion.view(motion.initial_state())
    set_action(state, (0.5, 0.3, 0.0), (0.5, -0.3, 0.0))
    assert not motion.prepare(state)
    assert "on the way to the place" in motion.reach_problem(state)


def test_the_hand_s_state_of_the_home_is_the_home():
    motion = motion_of()
    home = hand_state(motion.home_joints.tolist(), [0.0] * 7, BASE)
    np.testing.assert_allclose(home[:3], PARAMETERS.home[:3], atol=1e-9)
    np.testing.assert_array_equal(
        motion.motion_at(motion.view(motion.initial_state()), 5.0), [*motion.home_joints, *[0] * 14]
    )


def test_the_way_back_and_the_held_object_must_be_free_too():
    def problem(post: Capsule) -> str:
        motion = motion_of(obstacles=(post,))
        state = motion.view(motion.initial_state())
        set_action(state, (0.5, 0.3, 0.0), (0.5, -0.3, 0.0))
        said = motion.reach_problem(state)
        assert motion.prepare(state) == (not said)
        return said

    # The first post is beside the hand's way, but the carried tool would hit it.
    assert "on the way to the place" in problem(Capsule((0.7, 0.0, 0.0), (0.7, 0.0, 0.07), 0.02))
    assert problem(Capsule((0.8, 0.0, 0.0), (0.8, 0.0, 0.07), 0.02)) == ""
    # Only the way home passes through the space high above the place.
    assert "home" in problem(Capsule((0.55, -0.3, 0.46), (0.55, -0.3, 0.48), 0.03))


@pytest.mark.parametrize(("at_pick", "is_possible"), [(0.0, True), (0.14, False)])
def test_a_tall_thing_matters_only_if_it_is_near_the_wrist(at_pick: float, is_possible: bool):
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, (0.5, -0.25, 0.4), (0.58, 0.28, 1.5))
    state.clear_z = 0.14 + PARAMETERS.travel_clearance
    state.travel_z = state.clear_z + 0.015
    state.around_pick_z, state.around_place_z = at_pick, 0.14
    # The object is placed onto something 0.1 m high.
    state.floor_z, state.rim_z, state.place_hover_z = 0.1, 0.1, 0.13
    assert motion.prepare(state) == is_possible
    if not is_possible:
        assert "an object near the hand" in motion.reach_problem(state)


@pytest.mark.parametrize("doubt", [0.0, 0.002])
def test_the_arm_descends_more_slowly_if_the_heights_are_uncertain(doubt: float):
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, (0.6, 0.3, 0.4), (0.5, -0.3, 0.0))
    state.doubt = doubt
    assert motion.prepare(state)
    motion.begin(state, Mode.APPROACH, 0.0)
    start = motion.arrival(state)
    motion.begin(state, Mode.DESCEND, start)
    z = fingertips(states(motion, state, start, motion.arrival(state))[:, :7])[:, 2]
    speeds = -np.diff(z)[z[:-1] < 0.024] / 1e-3
    allowed = 0.02 if doubt else PARAMETERS.contact_speed
    assert 0.9 * allowed < speeds.max() < 1.05 * allowed


def test_a_trial_lift_never_brings_a_rising_hand_down():
    motion = motion_of()
    state = motion.view(motion.initial_state())
    set_action(state, (0.5, 0.2, 0.4), (0.5, -0.2, 1.0))
    assert motion.prepare(state)
    time = 1.0
    for mode in (Mode.APPROACH, Mode.DESCEND, Mode.CHECK):
        motion.begin(state, mode, time)
        time = motion.arrival(state)
    motion.begin(state, Mode.LIFT, time)
    time += 0.12
    state.doubts_grip = 1
    motion.begin(state, Mode.LIFT, time)
    heights = fingertips(states(motion, state, time, motion.arrival(state))[:, :7])[:, 2]
    assert heights[-1] > heights[0] + 0.005
    assert np.diff(heights).min() > -1e-5


def test_postures_from_which_the_joints_turn_little_are_preferred(monkeypatch: pytest.MonkeyPatch):
    motion, rng = motion_of(), np.random.default_rng(5)
    state = motion.view(motion.initial_state())

    def turn(stop: HandStop) -> float:
        """How far a joint turns while the hand sinks at the chosen posture, in rad."""
        (high,), problem = motion.postures.choose([stop], motion.home_joints)
        assert not problem
        down = np.linspace(stop.high, stop.low, 20)
        poses = np.array([[stop.x, stop.y, z, motion.postures.hand_pose(high)[3]] for z in down])
        return float(np.ptp(motion.postures.along(poses, high), axis=0).max())

    gains = []
    while len(gains) < 7:
        place = (rng.uniform(0.3, 0.34), rng.uniform(-0.2, 0.2), rng.uniform(-math.pi, math.pi))
        set_action(state, (0.5, 0.2, 0.0), place)
        if not motion.prepare(state):
            continue
        stop = motion.stops(state)[-1]
        preferred = turn(stop)
        with monkeypatch.context() as patch:
            patch.setattr("systems.arm_postures._PER_RADIAN", 0.0)
            gains.append(turn(stop) - preferred)
    assert min(gains) > -1e-9
    assert np.mean(gains) > 0.02


def test_where_the_joints_must_turn_far_to_lower_the_hand_it_sinks_more_slowly():
    """The kinetic energy of the arm is what an unexpected contact must absorb."""
    motion, rng = motion_of(), np.random.default_rng(5)
    inertia = ArmInertia(arm_model(FrankaArm(model="fr3"))[0])
    state = motion.view(motion.initial_state())
    energies: list[float] = []
    time = 1.0
    while len(energies) < 6:
        pick = (rng.uniform(0.4, 0.6), rng.uniform(0.1, 0.3), rng.uniform(-math.pi, math.pi))
        place = (rng.uniform(0.3, 0.34), rng.uniform(-0.2, 0.2), rng.uniform(-math.pi, math.pi))
        set_action(state, pick, place)
        if not motion.prepare(state):
            continue
        for mode in (Mode.APPROACH, Mode.DESCEND, Mode.LIFT, Mode.LOWER):
            motion.begin(state, mode, time)
            time = motion.arrival(state)
        lowering = states(motion, state, float(state.start_time), time)[::20]
        near = lowering[fingertips(lowering[:, :7])[:, 2] < 0.05]
        moving = zip(near[:, :7], near[:, 7:14], strict=True)
        energies.append(max(float(v @ inertia.mass(q) @ v) / 2 for q, v in moving))
    assert max(energies) < 0.004
