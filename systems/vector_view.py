"""Defines named fields of a state vector, like pydrake's `namedview`, but visible to type
checkers."""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Number:
    """A field of one element."""

    size = 1

    def __init__(self) -> None:
        self.index = 0

    @overload
    def __get__(self, view: None, owner: type) -> Number: ...
    @overload
    def __get__(self, view: VectorView, owner: type) -> float: ...
    def __get__(self, view: VectorView | None, owner: type) -> Number | float:
        return self if view is None else float(view.vector[self.index])

    def __set__(self, view: VectorView, value: float) -> None:
        view.vector[self.index] = value


class Array:
    """A field of several elements; reading it returns a writable view."""

    def __init__(self, size: int) -> None:
        self.index, self.size = 0, size

    @overload
    def __get__(self, view: None, owner: type) -> Array: ...
    @overload
    def __get__(self, view: VectorView, owner: type) -> NDArray[np.float64]: ...
    def __get__(self, view: VectorView | None, owner: type) -> Array | NDArray[np.float64]:
        return self if view is None else view.vector[self.index : self.index + self.size]

    def __set__(self, view: VectorView, value: ArrayLike) -> None:
        view.vector[self.index : self.index + self.size] = value


class VectorView:
    """Gives names to the elements of a vector. A subclass declares its fields in the order of the
    elements:

    class HandState(VectorView):
        position = Array(4)
        opening = Number()

    HandState(context.get_discrete_state(0).get_mutable_value()).opening = 0.08
    """

    size = 0
    """Number of elements of the vector."""

    def __init_subclass__(cls) -> None:
        # Before this loop, `cls.size` is that of the base class. So new fields follow the base's.
        for field in list(vars(cls).values()):
            if isinstance(field, Number | Array):
                field.index = cls.size
                cls.size += field.size

    def __init__(self, vector: NDArray[np.float64]) -> None:
        """
        Args:
            vector: (size,) the elements; writing a field modifies them.
        """
        self.vector = vector
