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
"""Exit code after a failed simulation or policy."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def seed_type(text: str) -> int:
    """Parses a seed, for `argparse`."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if seed not in ALL_SEEDS:
        last = ALL_SEEDS[-1]
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {last}")
    return seed


def count_type(text: str) -> int:
    """Parses a whole number of at least 1, for `argparse`."""
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
        A function that returns whether a signal has arrived. If so, the caller should raise
        KeyboardInterrupt.
    """
    came = False

    def note(number: int, frame: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        # Background jobs of a shell ignore Ctrl-C. Leave that unchanged.
        if handler != signal.SIG_IGN:
            signal.signal(number, note)
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, but not while trimesh is being imported.

    Trimesh catches exceptions in its optional imports, so the interrupt would be lost. A timer
    tries again until the exception can be raised.
    """
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] == "trimesh" and frame.f_code.co_name == "<module>":
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def run_command(main: Callable[[], int]) -> None:
    """Runs a command and exits with its exit code. A UserError is printed as one line."""
    # Hide Drake's messages about ports and frame names.
    logging.getLogger("drake").setLevel(logging.WARNING)
    # SIGTERM raises KeyboardInterrupt like Ctrl-C, so that files and processes are cleaned up.
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
