"""Command-line code that all commands share. It does not need pydrake."""

import argparse
import contextlib
import logging
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

from kitting_drake.common.errors import UserError
from kitting_drake.common.seeds import ALL_SEEDS

FAILED = 1
"""Exit code if a simulation or a policy failed."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def seed_type(text: str) -> int:
    """Parses a seed."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if seed not in ALL_SEEDS:
        last = ALL_SEEDS[-1]
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {last}")
    return seed


def count_type(text: str) -> int:
    """Parses a count of at least 1."""
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return count


@contextlib.contextmanager
def interrupts_wait() -> Iterator[Callable[[], bool]]:
    """Defers the first Ctrl-C or SIGTERM until the caller is ready; the second one interrupts.

    Yields:
        A function that says whether a signal came. The caller then raises KeyboardInterrupt.
    """
    came = False

    def note(number: int, frame: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        # A shell's background jobs ignore Ctrl-C.
        if handler != signal.SIG_IGN:
            signal.signal(number, note)
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, but not while trimesh is being imported.

    The optional imports of trimesh would catch the exception. A timer tries again until it can be
    raised.
    """
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] == "trimesh" and frame.f_code.co_name == "<module>":
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def run_command(main: Callable[[], int]) -> None:
    """Runs a command and exits with its code; prints a UserError as one line."""
    # Hide Drake's messages about ports and frame names.
    logging.getLogger("drake").setLevel(logging.WARNING)
    # Like Ctrl-C, SIGTERM raises KeyboardInterrupt, so that files and processes are cleaned up.
    signals = [signal.SIGTERM, signal.SIGALRM]
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signals.append(signal.SIGINT)
    for number in signals:
        signal.signal(number, _interrupt)
    try:
        code = main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = INTERRUPTED
    sys.exit(code)
