"""Work in fresh processes, several side by side: what takes it down takes no other with it."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from typing import Protocol, Self, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from kitting_drake.common.errors import UserError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_THREADS = "OMP_NUM_THREADS"

_MOST_AT_WORK = 1000
"""Each occupies a thread here, wherever it is at work."""


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
            "give fewer --workers, or nodes fewer CPUs, and it goes on where it was"
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


class Workers(Protocol):
    """A place where functions run in fresh processes: this machine, or a cluster."""

    def capacity(self) -> int:
        """How many processes it has room for now; at least 1."""

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        """Calls a function as `run_in_subprocess` does; may be called in many threads at once.

        Raises:
            UserError: the place is not fit for it.
        """

    def stop(self) -> None:
        """Kills what is at work, and lets nothing begin any more: nobody waits for what it finds.

        `run` returns a `ProcessCrashed` that was killed.
        """


class LocalWorkers:
    """This machine, as `Workers`. Inside its `with`, several processes use one thread each."""

    def __init__(self, count: int) -> None:
        """
        Args:
            count: how many processes at a time.
        """
        self._count = count
        self._stopped = False
        self._threads_before: str | None = None

    def __enter__(self) -> Self:
        self._threads_before = os.environ.get(_THREADS)
        if self._count > 1:
            # For the processes to come: this one has long read the variable.
            os.environ[_THREADS] = "1"
        return self

    def __exit__(self, *_: object) -> None:
        if self._threads_before is not None:
            os.environ[_THREADS] = self._threads_before
        else:
            os.environ.pop(_THREADS, None)

    def capacity(self) -> int:
        return self._count

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        if self._stopped:
            return ProcessCrashed(-signal.SIGKILL)
        return run_in_subprocess(function, *arguments)

    def stop(self) -> None:
        self._stopped = True
        for process in multiprocessing.active_children():
            process.kill()


def side_by_side(
    function: Callable[[_Item], _Result], draw: Callable[[], _Item | None], *, workers: Workers
) -> Iterator[_Result]:
    """Calls a function with one item after another, in threads; results come as they end.

    When it ends early, by Ctrl-C say, the workers are stopped.

    Args:
        function: called in a thread: lets `workers` do the work.
        draw: the next item; asked when there is room, in the caller's thread. None: none now, ask
            again after the next result; it is over when none is at work.
        workers: say how many threads.
    """
    with ThreadPoolExecutor(_MOST_AT_WORK) as pool:
        working: set[Future[_Result]] = set()
        try:
            while True:
                # Machines may have come, or gone.
                most = min(workers.capacity(), _MOST_AT_WORK)
                while len(working) < most and (item := draw()) is not None:
                    working.add(pool.submit(function, item))
                if not working:
                    return
                ended, working = wait(working, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield future.result()
        except BaseException:
            workers.stop()
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
