"""Any function from an observation to an action, as a Drake system."""

from __future__ import annotations

from collections.abc import Callable

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from systems.signals import Observation, PickPlaceAction


class PickPlacePolicy(LeafSystem):
    """Wraps a callable policy p(a_pick, a_place | o_t), section III-A of the paper.

    .. pydrake_system::

        name: PickPlacePolicy
        input_ports:
        - observation
        output_ports:
        - action

    - `observation` (abstract, `Observation`): o_t.
    - `action` (abstract, `PickPlaceAction`): the policy's answer.

    Pulled: the callable runs when the port is evaluated, once for each new observation. It lives
    outside the Context, which must stay cheap to copy, and must therefore not remember anything.
    """

    def __init__(self, *, policy: Callable[[Observation], PickPlaceAction]) -> None:
        """
        Args:
            policy: a function without memory. What it raises ends the evaluation of the port; an
                answer that is no `PickPlaceAction` is a `TypeError`.
        """
        super().__init__()
        self._policy = policy
        observation = self.DeclareAbstractInputPort("observation", Value(Observation()))
        self._observation = observation
        self.DeclareAbstractOutputPort(
            "action",
            lambda: Value(PickPlaceAction()),
            self._calc_action,
            {observation.ticket()},
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        action = self._policy(self._observation.Eval(context))
        if not isinstance(action, PickPlaceAction):
            raise TypeError(
                f"the policy {self._policy!r} answered with {type(action).__name__}, "
                "not a PickPlaceAction"
            )
        output.set_value(action)
