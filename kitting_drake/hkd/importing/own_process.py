"""Runs an import in a child process, because it may crash or take too long."""

import math
import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.import_request import ImportRequest
from kitting_drake.hkd.importing.prepare import Prepared, prepare_tool

TIME_LIMIT = 55.0
"""The processor time in seconds after which an import is aborted."""
MOST_WAITING = 20.0
"""The longest wall-clock time of one step, as a multiple of `TIME_LIMIT`.

This time is long, because it only serves to end a process that hangs, and a busy machine is slow.
"""
_MOST_MEMORY = 12 * 2**30


def prepare_aside(request: ImportRequest, name: str, made: Path, time_limit: float) -> Prepared:
    """Runs `prepare_tool` in a child process, which is killed after `time_limit` seconds of
    processor time.

    Raises:
        UserError: the tool cannot be made, or the child process crashes, hangs or is killed.
    """
    step = "starting"
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    arguments = (theirs, request, name, made, time_limit)
    process = context.Process(target=_child, args=arguments, daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            if not ours.poll(MOST_WAITING * TIME_LIMIT):
                raise UserError(
                    f"the import of {request.mesh} hung while {step}: decimate the mesh first"
                )
            said, error, result = ours.recv()
            if said is None:
                break
            step = said
    except EOFError as end:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            raise UserError(
                f"the import of {request.mesh} took more than {time_limit:.0f} s of processor time "
                f"and was stopped while {step}: decimate the mesh first"
            ) from end
        raise UserError(
            f"the import of {request.mesh} crashed while {step}: repair the mesh first"
        ) from end
    finally:
        process.kill()
        process.join()
        ours.close()
    if error is not None:
        raise UserError(error)
    return result


def _child(
    pipe: Connection, request: ImportRequest, name: str, made: Path, time_limit: float
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Discard the output of libraries; the result goes through the pipe.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
        most = max(1, math.ceil(time.process_time() + time_limit))
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    except (ImportError, ValueError, OSError):
        pass
    try:
        prepared = prepare_tool(request, name, made, lambda step: pipe.send((step, None, None)))
        pipe.send((None, None, prepared))
    except UserError as error:
        pipe.send((None, str(error), None))
