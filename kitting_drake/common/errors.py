"""Errors that are the user's to mend."""

DIVERGED = "a loss is no longer a number"
"""The words of the error with which a training ends that diverges."""


class UserError(ValueError):
    """Input that cannot be used. Its text is one sentence: what is wrong, where, what would do.

    Commands print it and leave with exit code 2.
    """


class MachineError(UserError):
    """The same where it is this machine that lacks something, such as a library or room on its
    disk: the input may be fine elsewhere."""
