"""Work in fresh processes, several side by side: what takes it down takes no other with it."""

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
"""A process is ended after so many calls: Drake 1.51 keeps every Diagram, so that each episode
leaves some fifty megabytes behind."""
_PATIENCE = 3.0
"""How long a process that is stopped may take to remove what it was writing, in s."""
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


class Subprocess:
    """A process that answers calls, one after another.

    Ctrl-C is not for it, and it ends when this process does.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        # The process inherits the mask: Ctrl-C is not for it, even while it starts.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.calls = 0
        """How many it has been given."""

    def call(
        self, function: Callable[..., _Result], *arguments: object
    ) -> _Result | ProcessCrashed:
        """Calls a function there, and waits for it.

        Args:
            function: importable by name, as its arguments and its result travel pickled. What it
                raises ends the process, but for a `MachineError`.
            arguments: its arguments.

        Returns:
            The function's result, or how the process ended if it returned none.

        Raises:
            MachineError: the function raised it.
        """
        self.calls += 1
        try:
            self._connection.send((function, arguments))
            answer = self._connection.recv()
        except (EOFError, OSError):
            # OSError: it died in the middle of its answer.
            self._process.join()
            return ProcessCrashed(self._process.exitcode)
        if isinstance(answer, MachineError):
            raise answer
        return answer

    def end(self) -> None:
        """Ends it, once it has answered."""
        self._connection.close()
        self._process.join()


def run_in_subprocess(
    function: Callable[..., _Result], *arguments: object
) -> _Result | ProcessCrashed:
    """Calls a function in a fresh process, and waits for it; as `Subprocess.call` does."""
    process = Subprocess()
    try:
        return process.call(function, *arguments)
    finally:
        process.end()


class Workers(Protocol):
    """A place where functions run in other processes: this machine, or a cluster."""

    def capacity(self) -> int:
        """How many processes it has room for now; at least 1."""

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        """Calls a function as `Subprocess.call` does; may be called in many threads at once.

        What ran in the process before must not matter to the function.

        Raises:
            UserError: the place is not fit for it, or the function raised a `MachineError`.
        """

    def stop(self) -> None:
        """Kills what is at work, and lets nothing begin any more: nobody waits for what it finds.

        `run` returns a `ProcessCrashed` that was killed.
        """


class LocalWorkers:
    """This machine, as `Workers`.

    Inside its `with`, several processes use one thread each, and a process answers several calls,
    as to start one and import everything takes seconds.
    """

    def __init__(self, count: int, *, reuse: bool = True) -> None:
        """
        Args:
            count: how many processes at a time.
            reuse: whether a process answers several calls; else each has a fresh one.
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
            # For the processes to come: this one has long read the variable.
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


def _serve(connection: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    terminated = False

    def terminate(*_: object) -> None:
        nonlocal terminated
        terminated = True
        raise KeyboardInterrupt

    # What is being written is removed on the way out.
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
        # The exit code tells what ended it.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)
