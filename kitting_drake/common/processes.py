"""Work in fresh processes, several side by side: what takes it down takes no other with it."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from kitting_drake.common.errors import UserError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_THREADS = "OMP_NUM_THREADS"


@dataclass(frozen=True)
class ProcessCrashed:
    """A process that ended without a result."""

    exit_code: int | None
    """Negative: the signal that killed it."""

    @property
    def was_killed(self) -> bool:
        """Whether something else killed it, for want of memory perhaps: not its own doing."""
        return self.exit_code in (-signal.SIGKILL, -signal.SIGTERM)

    def killed_twice(self, seed: int) -> UserError:
        """The error to raise when a second chance did not help."""
        return UserError(
            f"the process of seed {seed} was killed twice, perhaps for want of memory: "
            "give fewer --workers, and it goes on where it was"
        )


def run_in_subprocess(
    function: Callable[..., _Result], *arguments: object
) -> _Result | ProcessCrashed:
    """Calls a function in a fresh process, and waits for it.

    Args:
        function: importable by name, as its arguments and its result travel pickled. Ctrl-C is not
            for it, and it ends when this process does.
        arguments: its arguments.

    Returns:
        What the function returned, or how its process ended if it did not.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(function, arguments, sender), daemon=True)
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except (EOFError, OSError):
        # OSError: it died in the middle of its answer.
        process.join()
        return ProcessCrashed(process.exitcode)
    finally:
        process.join()


def side_by_side(
    function: Callable[[_Item], _Result], draw: Callable[[], _Item | None], *, workers: int
) -> Iterator[_Result]:
    """Calls a function with one item after another, in threads; results come as they end.

    With more than one worker, processes started meanwhile compute in one thread each. When it ends
    early, by Ctrl-C say, the processes at work are killed: nobody waits for what they find.

    Args:
        function: called in a thread: lets `run_in_subprocess` do the work.
        draw: the next item; asked when a thread is free, in the caller's thread. None: none now,
            ask again after the next result; it is over when none is at work.
        workers: how many threads.
    """
    with _one_thread_each(workers > 1), ThreadPoolExecutor(workers) as pool:
        working: set[Future[_Result]] = set()
        try:
            while True:
                while len(working) < workers and (item := draw()) is not None:
                    working.add(pool.submit(function, item))
                if not working:
                    return
                ended, working = wait(working, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield future.result()
        except BaseException:
            for process in multiprocessing.active_children():
                process.kill()
            raise


def counting_bar(console: Console, label: str) -> Progress:
    """A progress bar for things that are counted; invisible where there is no terminal."""
    return Progress(
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def _serve(function: Callable[..., object], arguments: tuple, sender: Connection) -> None:
    # Ctrl-C is the parent's to handle.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sender.send(function(*arguments))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)


@contextlib.contextmanager
def _one_thread_each(wanted: bool) -> Iterator[None]:
    """Lets processes started inside use one thread; this one has long read the variable."""
    before = os.environ.get(_THREADS)
    if wanted:
        os.environ[_THREADS] = "1"
    try:
        yield
    finally:
        if wanted and before is None:
            del os.environ[_THREADS]
        elif before is not None:
            os.environ[_THREADS] = before
