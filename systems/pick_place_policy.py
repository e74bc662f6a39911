"""Wraps a policy function, from observation to action, as a Drake system."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from systems.signals import STOP_REASONS, Observation, PickPlaceAction, PlanarPose
from systems.weak_calc import weak_calc


class PolicyFunction(Protocol):
    """A stateless policy function."""

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = (), /
    ) -> PickPlaceAction:
        """Returns the action for an observation.

        Args:
            observation: o_t, and the `history` of the episode.
            failed_picks: poses in the world of the picks whose actions failed, oldest first.
        """
        ...


class PolicyError(RuntimeError):
    """The policy function raised an exception, which is this error's `__cause__`."""


class PickPlacePolicy(LeafSystem):
    """Wraps a policy p(a_pick, a_place | o_t), section III-A of the paper.

    .. pydrake_system::

        name: PickPlacePolicy
        input_ports:
        - observation (or observation_heights)
        - failed_picks (optional)
        - history (optional)
        output_ports:
        - action

    - `observation` (abstract, `Observation`): o_t. If the policy uses only heights, the port is
      called `observation_heights` instead, and the colours may be missing.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): the planner's port of that name; empty if
      not connected.
    - `history` (abstract, a tuple of `Attempt`): the earlier actions, passed to the policy as
      `observation.history`. If not connected, the observation's own history stays.
    - `action` (abstract, `PickPlaceAction`): the policy's action.

    Evaluating `action` calls the policy once for each new input. The policy must be stateless: the
    Context does not hold its memory. Any memory must enter through an input port.
    """

    def __init__(self, *, policy: PolicyFunction, heights_only: bool = False) -> None:
        """
        Args:
            policy: the function that computes the action. If it raises, evaluating the port
                `action` raises a `PolicyError`. If it does not return a `PickPlaceAction` of
                numbers, a `TypeError` is raised. If one of its poses is not finite, or its reason
                is unknown, a `ValueError` is raised.
            heights_only: whether the policy uses only the heights of o_t, not its colours.
        """
        super().__init__()
        self._policy = policy
        name = "observation_heights" if heights_only else "observation"
        self._observation = self.DeclareAbstractInputPort(name, Value(Observation()))
        self._failed_picks = self.DeclareAbstractInputPort("failed_picks", Value(()))
        self._history = self.DeclareAbstractInputPort("history", Value(()))
        self.DeclareAbstractOutputPort(
            "action",
            lambda: Value(PickPlaceAction()),
            weak_calc(self._calc_action),
            {port.ticket() for port in (self._observation, self._failed_picks, self._history)},
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        given = self._failed_picks.HasValue(context)
        failed_picks = self._failed_picks.Eval(context) if given else ()
        observation = self._observation.Eval(context)
        if self._history.HasValue(context):
            observation = dataclasses.replace(observation, history=self._history.Eval(context))
        try:
            action = self._policy(observation, failed_picks)
        except (Exception, SystemExit) as error:
            raise PolicyError(f"the policy {self._policy!r} failed: {error}") from error
        if not isinstance(action, PickPlaceAction):
            raise TypeError(
                f"the policy {self._policy!r} must return a PickPlaceAction, not "
                f"{type(action).__name__}"
            )
        output.set_value(self._checked(action))

    def _checked(self, action: PickPlaceAction) -> PickPlaceAction:
        """The action, with its poses converted to floats.

        Raises:
            TypeError: a pose does not consist of numbers.
            ValueError: a pose is not finite, or `reason` is not a key of `STOP_REASONS`.
        """
        if action.reason and action.reason not in STOP_REASONS:
            raise ValueError(
                f"the policy {self._policy!r} must return one of "
                f"{', '.join(STOP_REASONS)} as reason, not {action.reason!r}"
            )
        numbers: dict[str, Any] = {}
        for name, pose in action.poses.items():
            if not isinstance(pose, PlanarPose):
                raise TypeError(
                    f"the policy {self._policy!r} must return a PlanarPose as {name}, not {pose!r}"
                )
            values = (pose.x, pose.y, pose.theta)
            if any(isinstance(value, str) for value in values):
                raise TypeError(
                    f"the policy {self._policy!r} must return numbers in {name}, not {pose!r}"
                )
            numbers[name] = PlanarPose(*map(float, values))
            if not np.isfinite(numbers[name].as_array()).all():
                raise ValueError(
                    f"the policy {self._policy!r} must return finite poses, not {action}"
                )
        return dataclasses.replace(action, **numbers)
