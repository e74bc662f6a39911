"""Errors that a user can fix."""

DIVERGED = "a loss is no longer finite"
"""Message of the error that ends a training run that has diverged."""


class UserError(ValueError):
    """Invalid input. The message is one sentence that says what is wrong, where, and what to do.

    Commands print it and exit with code 2.
    """


class MachineError(UserError):
    """This machine lacks something, for example a library or disk space. The input may work on
    another machine."""
