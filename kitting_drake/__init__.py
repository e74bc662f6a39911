"""Robotic kitting in Drake: the station, the tasks, the data set and the policies."""

import itertools
import sys
from types import TracebackType

__version__ = "0.1.0"


def _end_quietly(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    """Suppresses the traceback of Ctrl-C."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, traceback)


if any(
    flag == "-m" and module.startswith("kitting_drake")
    for flag, module in itertools.pairwise(sys.orig_argv)
):
    # Install the handler now, because Ctrl-C may arrive while a command still imports modules.
    sys.excepthook = _end_quietly
