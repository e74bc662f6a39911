"""Plans the joint trajectory of a whole pick and place of a Franka arm before it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.arm_limits import JOINTS, limits_used
from systems.arm_motion import ArmMotion, ArmState
from systems.arm_way import WayVector
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.signals import PickPlaceAction, SurfaceHeights

FASTEST_RATE, SLOWEST_RATE = 1000, 200
"""Highest and lowest rate of a trajectory, in Hz. Franka's controller runs at 1 kHz. Below 200 Hz
the interpolated motion would exceed the limits of acceleration by a few percent."""


@dataclass(frozen=True)
class Segment:
    """The part of a trajectory that belongs to one mode of the planner."""

    mode: str
    """Name of the mode, such as `APPROACH`."""
    first: int
    """Index of the segment's first point. The last point of a segment is the first point of the
    next one."""
    last: int
    stop_force: float | None = None
    """The vertical contact force on the hand, in N, above which the arm should stop; None if no
    contact is expected."""


@dataclass(frozen=True)
class JawCommand:
    """A command to the jaws, with the arguments of the Franka Hand's `move` and `grasp`."""

    time: float
    """Time of the command since the start of the trajectory, in s."""
    width: float
    """Commanded opening between the pads, in m."""
    speed: float
    """Rate at which the opening changes, in m/s."""
    force: float = 0.0
    """Force with which the jaws hold an object, in N; zero if they only move."""


@dataclass(frozen=True)
class ArmTrajectory:
    """Joint positions, velocities and accelerations at a constant rate, from rest to rest."""

    rate: float
    """Rate of the points, in Hz."""
    positions: NDArray[np.float64]
    """(n, 7) joint positions, in rad. `velocities` are in rad/s, `accelerations` in rad/s^2."""
    velocities: NDArray[np.float64]
    accelerations: NDArray[np.float64]
    segments: tuple[Segment, ...] = ()
    jaws: tuple[JawCommand, ...] = ()
    start_width: float = 0.08
    """Opening between the pads at the start, in m."""
    limits_used: tuple[tuple[str, float], ...] = ()
    """For each kind of limit, its name and the largest fraction of it that the motion uses.
    For positions the fraction is the distance from the middle of a joint's range, divided by half
    the range."""

    @property
    def times(self) -> NDArray[np.float64]:
        """(n) times of the points since the start, in s."""
        return np.arange(len(self.positions)) / self.rate

    @property
    def duration(self) -> float:
        """Duration of the trajectory, in s."""
        return (len(self.positions) - 1) / self.rate

    def at(self, time: float) -> NDArray[np.float64]:
        """(21) joint positions, velocities and accelerations, in rad and s. The time, in s, is
        counted from the start. The arm is at rest before the start and after the end.

        Between the points, positions follow polynomials of degree 5 that fit position, velocity and
        acceleration at both ends, as in ROS's `joint_trajectory_controller`.
        """
        if not 0.0 <= time < self.duration:
            end = self.positions[0 if time < 0.0 else -1]
            return np.concatenate([end, np.zeros(2 * JOINTS)])
        index = min(int(time * self.rate), len(self.positions) - 2)
        q, v, a = (
            it[index : index + 2] for it in (self.positions, self.velocities, self.accelerations)
        )
        return quintic(q, v, a, step=1 / self.rate, since=time - index / self.rate)

    def width_at(self, time: float) -> tuple[float, float]:
        """Returns the opening of the jaws, in m, and its rate, in m/s. The jaws are assumed to be
        empty."""
        width, rate, since = self.start_width, 0.0, 0.0
        goal, speed = width, 0.0
        for command in (*self.jaws, None):
            end = time if command is None else min(command.time, time)
            way = goal - width
            moved = min(speed * max(end - since, 0.0), abs(way))
            rate = math.copysign(speed, way) if moved < abs(way) else 0.0
            width += math.copysign(moved, way)
            if command is None or command.time > time:
                break
            since, goal, speed = command.time, command.width, command.speed
        return width, rate

    def force_at(self, time: float) -> float:
        """The closing force of the jaws at a time, in N."""
        force = 0.0
        for command in self.jaws:
            if command.time <= time:
                force = command.force
        return force


def quintic(
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    a: NDArray[np.float64],
    step: float,
    since: float,
) -> NDArray[np.float64]:
    """(3 k) values, first and second derivatives of k polynomials of degree 5 through two points.

    Args:
        q: (2, k) values at the two points.
        v: (2, k) first derivatives at the two points.
        a: (2, k) second derivatives at the two points.
        step: time between the points, in s.
        since: time from the first point to the time of evaluation, in s.
    """
    # Subtract the parabola with the given value and derivatives at the first point. The difference
    # is a polynomial in s = since / step with the powers 3 to 5.
    h = step
    first = q[1] - q[0] - h * v[0] - h * h / 2 * a[0]
    second = h * (v[1] - v[0] - h * a[0])
    third = h * h * (a[1] - a[0])
    c3 = 10 * first - 4 * second + third / 2
    c4 = -15 * first + 7 * second - third
    c5 = 6 * first - 3 * second + third / 2
    s = since / h
    return np.concatenate(
        [
            q[0] + since * v[0] + since**2 / 2 * a[0] + s**3 * (c3 + s * (c4 + s * c5)),
            v[0] + since * a[0] + s**2 / h * (3 * c3 + s * (4 * c4 + s * 5 * c5)),
            a[0] + s / h**2 * (6 * c3 + s * (12 * c4 + s * 20 * c5)),
        ]
    )


def plan_action(
    motion: ArmMotion,
    parameters: PickPlaceParameters,
    action: PickPlaceAction,
    surfaces: SurfaceHeights,
    *,
    joints: NDArray[np.float64] | None = None,
    rate: int = FASTEST_RATE,
) -> ArmTrajectory | str:
    """Plans the joint trajectory of an action, as the planner would execute it.

    Contacts are not known in advance. So the arm descends to the grasp height, and the jaws get the
    time to close and to open fully. The held object is lowered to the surface that o_t shows at its
    place. If the place is in a cavity, the fingertips stay above its rim, and the object may drop
    the rest of the way.

    Args:
        motion: plans the arm's motions.
        parameters: the parameters of `motion`.
        action: a pick and place, or a press.
        surfaces: heights of the surfaces around pick and place.
        joints: (7) joint positions at which the arm starts, at rest, in rad; if None,
            `motion.home_joints`.
        rate: rate of the points, in Hz, from `SLOWEST_RATE` to `FASTEST_RATE`.

    Returns:
        The trajectory, or a sentence that says why the arm cannot execute the action.
    """
    state = motion.view(motion.initial_state())
    if joints is not None:
        WayVector(state.way).start[:JOINTS] = joints
    _set_action(state, action, surfaces, parameters)
    problem = motion.reach_problem(state)
    if problem:
        return problem
    state.refused = not motion.prepare(state)
    assert not state.refused
    # Check the limits at 1 kHz or more, even if the rate of the points is lower.
    finer = math.ceil(FASTEST_RATE / rate)
    recorder = _Recorder(motion, state, parameters, rate, finer)
    recorder.record()
    samples = np.array(recorder.samples)
    used = limits_used(samples, motion.postures.limits, rate * finer)
    for name, share in used:
        if share > 1.0:
            raise RuntimeError(
                f"the planned trajectory uses {100 * share:.1f} % of the {name} limit"
            )
    positions, velocities, accelerations = np.split(samples[::finer], 3, axis=1)
    return ArmTrajectory(
        rate,
        positions,
        velocities,
        accelerations,
        tuple(recorder.segments),
        tuple(recorder.jaws),
        parameters.open_width,
        used,
    )


def _set_action(
    state: ArmState,
    action: PickPlaceAction,
    surfaces: SurfaceHeights,
    parameters: PickPlaceParameters,
) -> None:
    """Writes an action and its heights into the state, as the planner does."""
    place = action.pick if action.press else action.place
    state.pick, state.place = action.pick.as_array(), place.as_array()
    state.press, state.actions = action.press, 1
    state.set_heights(motion_heights(surfaces, parameters), surfaces)


class _Recorder:
    """Steps through the modes of an action without contacts, and samples the motion."""

    def __init__(
        self,
        motion: ArmMotion,
        state: ArmState,
        parameters: PickPlaceParameters,
        rate: float,
        finer: int,
    ) -> None:
        self._motion, self._state, self._parameters = motion, state, parameters
        self._rate, self._finer = rate, finer
        self._point = 0
        self.samples: list[NDArray[np.float64]] = []
        self.segments: list[Segment] = []
        self.jaws: list[JawCommand] = []

    def record(self) -> None:
        """Records all modes, from `APPROACH` to the end of `RETREAT`."""
        state, parameters = self._state, self._parameters
        contact = parameters.contact_threshold
        self._mode(Mode.APPROACH)
        if state.press:
            self._mode(Mode.DESCEND, stop_force=parameters.press_stop_force)
            self._mode(Mode.RETREAT)
        else:
            self._mode(Mode.DESCEND, stop_force=contact)
            self._mode(Mode.CLOSE)
            self._mode(Mode.CHECK, settle=parameters.tare_settle)
            state.hold_z = state.grasp_z
            self._mode(Mode.LIFT)
            self._mode(Mode.CARRY, settle=parameters.tare_settle)
            self._mode(Mode.LOWER, stop_force=contact)
            self._mode(Mode.RELEASE)
            self._mode(Mode.RETREAT)
        self.samples.append(self._motion.motion_at(state, self._point / self._rate))

    def _mode(self, mode: Mode, settle: float = 0.0, stop_force: float | None = None) -> None:
        """Begins a mode, and samples its motion until the arm has arrived and rested for `settle`
        seconds."""
        state, motion, first = self._state, self._motion, self._point
        begun = first / self._rate
        motion.begin(state, mode, begun)
        lowest = state.table_z + self._parameters.floor_clearance
        if mode == Mode.LOWER:
            # Lower the object to the surface that o_t shows at the place, not to the table. The
            # fingers go at most down to the rim, because a trajectory does not stop at a contact.
            hanging = max(state.grasp_z - state.support_z, 0.0)
            goal = max(state.floor_z + hanging, state.rim_z + state.doubt)
            motion.back_off(state, max(goal - lowest, 0.0))
        elif mode == Mode.DESCEND and state.press:
            # A trajectory does not stop at a contact, so keep the hand's goal above the table.
            goal = state.pick_top_z - self._parameters.press_depth
            motion.back_off(state, max(lowest - goal, 0.0))
        elif mode == Mode.RELEASE:
            # The object's width is unknown, so open the jaws fully.
            state.goal_opening = self._parameters.open_width
        self._command_jaws(mode, begun)
        while not self._is_over(mode, settle):
            for fraction in range(self._finer):
                time = (self._point + fraction / self._finer) / self._rate
                self.samples.append(motion.motion_at(state, time))
            self._point += 1
        self.segments.append(Segment(mode.name, first, self._point, stop_force))

    def _is_over(self, mode: Mode, settle: float) -> bool:
        time = self._point / self._rate
        if mode == Mode.LIFT:
            return self._motion.brakes_above(self._state, time, self._state.travel_z)
        return time >= self._motion.arrival(self._state) + settle

    def _command_jaws(self, mode: Mode, time: float) -> None:
        parameters = self._parameters
        if mode in (Mode.APPROACH, Mode.CLOSE, Mode.RELEASE):
            force = parameters.grasp_force if mode == Mode.CLOSE else 0.0
            speed = 2 * parameters.finger_speed
            self.jaws.append(JawCommand(time, self._state.goal_opening, speed, force))
