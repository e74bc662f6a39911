"""Callbacks of output ports that do not keep their system alive."""

import weakref
from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context


def weak_calc(method: Callable[..., None], *first: Any) -> Callable[[Context, AbstractValue], None]:
    """The `calc` of an abstract output port, from a method of the system that declares it.

    Drake holds the callback of an abstract output port where Python's garbage collector does not
    see it: one that holds its system, as a bound method does, keeps it in memory for good, and with
    it the Diagram, its plant and its render engines. (Drake 1.51 keeps them in any case.)

    Args:
        method: a bound method that takes `first`, a Context and the output's value.
        first: its first arguments.
    """
    reference = weakref.WeakMethod(method)

    def calc(context: Context, output: AbstractValue) -> None:
        bound = reference()
        assert bound is not None, "a system is there as long as its ports are"
        bound(*first, context, output)

    return calc
