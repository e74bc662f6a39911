"""Runs functions in parallel in separate processes, so that a crash affects only one of them."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from typing import Protocol, Self, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from kitting_drake.common.errors import MachineError, UserError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_THREADS = "OMP_NUM_THREADS"

_MOST_CALLS = 10
"""A process is replaced after this many calls, because Drake 1.51 (for Python 3.11) never frees
Diagrams, which take about 50 MB for each episode."""
_PATIENCE = 3.0
"""Time for a stopped process to remove partial files, in s."""
_MOST_AT_WORK = 1000
"""Largest number of parallel calls. Each of them occupies a thread of this process."""


@dataclass(frozen=True)
class ProcessCrashed:
    """A process that ended without a result."""

    exit_code: int | None
    """Exit code of the process; if signal n killed it, -n."""

    @property
    def was_killed(self) -> bool:
        """Whether the process was killed from outside, for example for lack of memory."""
        return self.exit_code in (-signal.SIGKILL, -signal.SIGTERM)

    def killed_twice(self, seed: int) -> UserError:
        """The error to raise if a seed was tried again and its process was killed again."""
        return UserError(
            f"the process of seed {seed} was killed twice, perhaps for lack of memory: run the "
            "command again with fewer --workers, or fewer CPUs per node, to resume"
        )


class Subprocess:
    """A process that executes calls one after another.

    It ignores Ctrl-C and ends with its parent.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        # Block Ctrl-C in the signal mask. The new process inherits the mask, so it ignores Ctrl-C
        # from the beginning.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.calls = 0
        """Number of calls that this process has executed."""

    def call(
        self, function: Callable[..., _Result], *arguments: object
    ) -> _Result | ProcessCrashed:
        """Calls a function in the process and waits for it.

        Args:
            function: a function that can be imported by name. Its arguments and its result must be
                picklable. Exceptions other than `MachineError` end the process.
            arguments: the arguments of the function.

        Returns:
            The function's result, or how the process ended without one.

        Raises:
            MachineError: raised by the function.
        """
        self.calls += 1
        try:
            self._connection.send((function, arguments))
            answer = self._connection.recv()
        except (EOFError, OSError):
            # The process ended; an OSError means that it died while sending its result.
            self._process.join()
            return ProcessCrashed(self._process.exitcode)
        if isinstance(answer, MachineError):
            raise answer
        return answer

    def end(self) -> None:
        """Ends the process, after its present call."""
        self._connection.close()
        self._process.join()


def run_in_subprocess(
    function: Callable[..., _Result], *arguments: object
) -> _Result | ProcessCrashed:
    """Calls a function in a fresh process, by `Subprocess.call`."""
    process = Subprocess()
    try:
        return process.call(function, *arguments)
    finally:
        process.end()


class Workers(Protocol):
    """The interface of workers, which run functions in other processes, on this machine or on a
    cluster."""

    def capacity(self) -> int:
        """The number of calls that can run at the same time; at least 1. It may change."""

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        """Calls a function in a process, as `Subprocess.call` does. This method is thread-safe.

        Processes may be reused, so the function must not depend on earlier calls.

        Raises:
            UserError: a worker cannot run the function, for example because a package is missing,
                or the function raised a `MachineError`.
        """

    def stop(self) -> None:
        """Ends all running calls and accepts no more.

        `run` then returns a `ProcessCrashed`.
        """


class LocalWorkers:
    """This machine, as `Workers`. Use it in a `with` statement.

    If there are several processes, each uses one thread. Processes are reused, because the start of
    a process and its imports take seconds.
    """

    def __init__(self, count: int, *, reuse: bool = True) -> None:
        """
        Args:
            count: number of parallel processes.
            reuse: whether a process executes several calls. If not, each call gets a new process.
        """
        self._count = count
        self._reuse = reuse
        self._stopped = False
        self._threads_before: str | None = None
        self._most_calls = 1
        self._idle: list[Subprocess] = []

    def __enter__(self) -> Self:
        if self._reuse:
            self._most_calls = _MOST_CALLS
        self._threads_before = os.environ.get(_THREADS)
        if self._count > 1:
            # This affects only processes that are started later.
            os.environ[_THREADS] = "1"
        return self

    def __exit__(self, *_: object) -> None:
        self._most_calls = 1
        while self._idle:
            self._idle.pop().end()
        if self._threads_before is not None:
            os.environ[_THREADS] = self._threads_before
        else:
            os.environ.pop(_THREADS, None)

    def capacity(self) -> int:
        return self._count

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        if self._stopped:
            return ProcessCrashed(-signal.SIGKILL)
        try:
            process = self._idle.pop()
        except IndexError:
            process = Subprocess()
        try:
            outcome = process.call(function, *arguments)
        except MachineError:
            process.end()
            raise
        if isinstance(outcome, ProcessCrashed) or process.calls >= self._most_calls:
            process.end()
        else:
            self._idle.append(process)
        return outcome

    def stop(self) -> None:
        self._stopped = True
        processes = multiprocessing.active_children()
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + _PATIENCE
        for process in processes:
            process.join(max(deadline - time.monotonic(), 0.0))
            process.kill()


def side_by_side(
    function: Callable[[_Item], _Result], draw: Callable[[], _Item | None], *, workers: Workers
) -> Iterator[_Result]:
    """Calls a function for each item, in threads; yields results as they complete.

    If the iteration ends early, for example by Ctrl-C, the workers are stopped.

    Args:
        function: a function that is called in a thread and delegates the work to `workers`.
        draw: returns the next item, in the caller's thread. If it returns None, it is called again
            after the next result, and the iteration ends when no call is running.
        workers: the workers, whose capacity determines the number of threads.
    """
    with ThreadPoolExecutor(_MOST_AT_WORK) as pool:
        working: set[Future[_Result]] = set()
        try:
            while True:
                # The capacity of a cluster may change, so ask for it each time.
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
    """A progress bar with a count. It is invisible if the output is not a terminal."""
    return Progress(
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def _serve(connection: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    terminated = False

    def terminate(*_: object) -> None:
        nonlocal terminated
        terminated = True
        raise KeyboardInterrupt

    # Raise an exception, so that partial files are removed.
    signal.signal(signal.SIGTERM, terminate)
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        while not terminated:
            function, arguments = connection.recv()
            try:
                answer = function(*arguments)
            except MachineError as error:
                answer = error
            connection.send(answer)
    if terminated:
        # End by the signal itself, so that the exit code shows it.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)
