"""Creates callbacks for output ports. The callbacks do not keep their system alive."""

import weakref
from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context


def weak_calc(method: Callable[..., None], *first: Any) -> Callable[[Context, AbstractValue], None]:
    """Returns the `calc` callback of an abstract output port, with a weak reference to its system.

    Python's garbage collector cannot see the callbacks that Drake holds. A bound method would
    therefore keep its system alive forever, and with it the Diagram, plant and render engines.
    (Drake 1.51 keeps them alive in any case.)

    Args:
        method: a bound method of the system. Its arguments are `first`, a Context and the output's
            value.
        first: values of the method's first arguments.
    """
    reference = weakref.WeakMethod(method)

    def calc(context: Context, output: AbstractValue) -> None:
        bound = reference()
        assert bound is not None, "the system outlives its ports"
        bound(*first, context, output)

    return calc
