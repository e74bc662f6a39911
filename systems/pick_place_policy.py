"""Any function from an observation to an action, as a Drake system."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from systems.signals import Observation, PickPlaceAction, PlanarPose
from systems.weak_calc import weak_calc


class PolicyFunction(Protocol):
    """A policy: a function without memory."""

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = (), /
    ) -> PickPlaceAction:
        """The action for an observation.

        Args:
            observation: o_t.
            failed_picks: where a grasp failed before, in the world, the latest last.
        """
        ...


class PolicyError(RuntimeError):
    """A policy's own function failed; `__cause__` is what it raised."""


class PickPlacePolicy(LeafSystem):
    """Wraps a policy p(a_pick, a_place | o_t), section III-A of the paper.

    .. pydrake_system::

        name: PickPlacePolicy
        input_ports:
        - observation (or observation_heights)
        - failed_picks (optional)
        output_ports:
        - action

    - `observation` (abstract, `Observation`): o_t. A policy that looks at heights alone has
      `observation_heights` instead: o_t, perhaps without colours.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): where a grasp failed before; none where
      the port is not connected.
    - `action` (abstract, `PickPlaceAction`): the policy's answer.

    The policy is called when the port is evaluated, once for each new input. It lives outside the
    Context, which must stay cheap to copy, and must therefore not remember anything: what there is
    to remember comes in by a port.
    """

    def __init__(self, *, policy: PolicyFunction, heights_only: bool = False) -> None:
        """
        Args:
            policy: what it raises ends the evaluation of the port as a `PolicyError`; an answer
                that is not a `PickPlaceAction` does as a `TypeError`, and one whose poses are not
                finite numbers as a `ValueError`.
            heights_only: whether it looks at heights alone.
        """
        super().__init__()
        self._policy = policy
        name = "observation_heights" if heights_only else "observation"
        self._observation = self.DeclareAbstractInputPort(name, Value(Observation()))
        self._failed_picks = self.DeclareAbstractInputPort("failed_picks", Value(()))
        self.DeclareAbstractOutputPort(
            "action",
            lambda: Value(PickPlaceAction()),
            weak_calc(self._calc_action),
            {self._observation.ticket(), self._failed_picks.ticket()},
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        given = self._failed_picks.HasValue(context)
        failed_picks = self._failed_picks.Eval(context) if given else ()
        observation = self._observation.Eval(context)
        try:
            action = self._policy(observation, failed_picks)
        except (Exception, SystemExit) as error:
            raise PolicyError(f"the policy {self._policy!r} failed: {error}") from error
        if not isinstance(action, PickPlaceAction):
            raise TypeError(
                f"the policy {self._policy!r} answered with {type(action).__name__}, "
                "not a PickPlaceAction"
            )
        output.set_value(self._checked(action))

    def _checked(self, action: PickPlaceAction) -> PickPlaceAction:
        """The action with its poses in use as floats.

        Raises:
            TypeError: they are not numbers.
            ValueError: they are not finite.
        """
        numbers: dict[str, Any] = {}
        for name, pose in action.poses.items():
            if not isinstance(pose, PlanarPose):
                raise TypeError(
                    f"the policy {self._policy!r} answered with a {name} that is no PlanarPose: "
                    f"{pose!r}"
                )
            values = (pose.x, pose.y, pose.theta)
            if any(isinstance(value, str) for value in values):
                raise TypeError(
                    f"the policy {self._policy!r} answered with a {name} of text: {pose!r}"
                )
            numbers[name] = PlanarPose(*map(float, values))
            if not np.isfinite(numbers[name].as_array()).all():
                raise ValueError(
                    f"the policy {self._policy!r} answered with no finite numbers: {action}"
                )
        return dataclasses.replace(action, **numbers)
