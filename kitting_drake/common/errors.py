"""Errors that a user can fix."""

DIVERGED = "a loss is no longer a number"
"""Message of the error that ends a diverged training."""


class UserError(ValueError):
    """Invalid input. The message is one sentence: what is wrong, where, and what to do.

    Commands print it and exit with code 2.
    """


class MachineError(UserError):
    """This machine lacks something, e.g. a library or disk space. The input may work elsewhere."""
