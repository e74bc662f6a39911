"""The parts of a command line that all commands share; no pydrake here."""

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
"""Exit code when a simulation or a policy failed, and nothing else can be blamed."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def seed_type(text: str) -> int:
    """A seed given on the command line."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if seed not in ALL_SEEDS:
        last = ALL_SEEDS[-1]
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {last}")
    return seed


def count_type(text: str) -> int:
    """A count given on the command line: 1 or more."""
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return count


@contextlib.contextmanager
def interrupts_wait() -> Iterator[Callable[[], bool]]:
    """Lets Ctrl-C, and being told to end (SIGTERM), wait for a good moment; a second does not wait.

    Yields:
        Whether there was one: who asks goes on to raise KeyboardInterrupt.
    """
    came = False

    def note(number: int, frame: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        # Ctrl-C is ignored in jobs that a shell starts in the background.
        if handler != signal.SIG_IGN:
            signal.signal(number, note)
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, a little later if trimesh is being imported: its optional imports
    catch everything."""
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] == "trimesh" and frame.f_code.co_name == "<module>":
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def run_command(main: Callable[[], int]) -> None:
    """Runs a command and exits with its code; prints a user's error as one sentence."""
    # Drake announces ports and frame names; a command says itself what a person needs to know.
    logging.getLogger("drake").setLevel(logging.WARNING)
    # SIGTERM ends a command as Ctrl-C does: with its files and its processes in order.
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
