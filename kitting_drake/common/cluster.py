"""Runs functions on a Ray cluster. Only this module needs Ray."""

import importlib
import logging
import operator
import os
import pickle
import platform
import signal
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self, TypeVar

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.processes import ProcessCrashed, run_in_subprocess
from kitting_drake.common.provenance import versions

_Result = TypeVar("_Result")

_RETRIES = 5
"""Number of retries of a call whose node or worker dies."""

_PATIENCE = 5.0
"""Timeout for connecting to the cluster's address, in s."""


@dataclass(frozen=True)
class _Unfit:
    """The result of a call on a node that cannot run it, for example because a package is missing
    there."""

    reason: str


class RayWorkers:
    """The CPUs of a Ray cluster, as `Workers`. Use it in a `with` statement.

    A call occupies one CPU and runs in a fresh process. If its node dies, the call is retried on
    another node. Only the calling process writes files.
    """

    def __init__(self, address: str, runtime_env: dict[str, Any]) -> None:
        """
        Args:
            address: `auto`, `HOST:PORT` or `ray://HOST:PORT`.
            runtime_env: Ray's runtime environment of the workers. Its `working_dir` contains this
                package.
        """
        self._address = address
        self._runtime_env = runtime_env
        self._versions = versions()
        self._lock = threading.Lock()
        self._stopped = False
        self._at_work: set[Any] = set()

    def __enter__(self) -> Self:
        """Connects to the cluster.

        Raises:
            UserError: Ray is not installed, no cluster is at the address, or the cluster rejects
                the runtime environment.
        """
        # Ray reports a dead node in one message. This setting keeps it from also printing the
        # node's log.
        os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")
        self._ray = import_extra("ray", purpose="--ray", extra="cluster")
        address = _find_cluster(self._address)
        try:
            self._ray.init(
                address=address,
                runtime_env=self._runtime_env,
                logging_level=logging.ERROR,
                log_to_driver=False,
            )
        except (
            OSError,
            RuntimeError,
            ValueError,
            self._ray.exceptions.RuntimeEnvSetupError,
        ) as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise UserError(f"--ray {self._address}: cannot use the cluster: {reason}") from error
        self._remote = self._ray.remote(num_cpus=1, max_retries=_RETRIES)(_serve)
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()

    def capacity(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def run(self, function: Callable[..., _Result], *arguments: object) -> _Result | ProcessCrashed:
        exceptions = self._ray.exceptions
        call = pickle.dumps((*_name(function), arguments))
        with self._lock:
            if self._stopped:
                return ProcessCrashed(-signal.SIGKILL)
            answer = self._remote.remote(self._versions, call)
            self._at_work.add(answer)
        try:
            outcome = self._ray.get(answer)
        except (exceptions.RayTaskError, exceptions.RuntimeEnvSetupError) as error:
            last_line = str(error).strip().splitlines()[-1]
            raise UserError(f"a node of the cluster cannot run the work: {last_line}") from error
        except exceptions.RayError:
            # All retries failed, or the call was cancelled.
            return ProcessCrashed(-signal.SIGKILL)
        finally:
            with self._lock:
                self._at_work.discard(answer)
        if isinstance(outcome, ProcessCrashed):
            return outcome
        result = pickle.loads(outcome)
        if isinstance(result, _Unfit):
            raise UserError(result.reason)
        return result

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for answer in self._at_work:
                self._ray.cancel(answer, force=True)


def _find_cluster(address: str) -> str:
    """Finds the address of a running cluster. If there is none, this function fails at once,
    whereas Ray retries for minutes.

    Raises:
        UserError: nothing listens at the address, or no cluster runs on this machine.
    """
    found = address
    if address == "auto":
        services = importlib.import_module("ray._private.services")
        try:
            found = services.get_ray_address_from_environment("auto", None)
        except ConnectionError as error:
            raise UserError(
                "--ray auto: there is no cluster on this machine: start one, see docs/cluster.md"
            ) from error
    host, _, port = found.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise UserError(f"--ray takes auto, HOST:PORT or ray://HOST:PORT, not '{found}'")
    try:
        socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"--ray {address}: there is no cluster at {host}:{port} ({reason}): start one, see "
            "docs/cluster.md"
        ) from error
    return found


def _name(function: Callable[..., object]) -> tuple[str, str]:
    """The module and name by which another process can import a function."""
    module = function.__module__
    if module == "__main__":
        # With `python -m` the module is called `__main__`, but only in this process. Use its real
        # name.
        module = sys.modules["__main__"].__spec__.name  # type: ignore[union-attr]
    return module, function.__qualname__


def _serve(versions_wanted: dict[str, str], call: bytes) -> bytes | ProcessCrashed:
    """Runs a call on a node. Call and result are passed as bytes, so that this function needs few
    imports."""
    return run_in_subprocess(_answer, versions_wanted, call)


def _answer(versions_wanted: dict[str, str], call: bytes) -> bytes:
    """Runs a call in a fresh process on a node; returns the pickled result, or an `_Unfit`."""
    node = platform.node()
    try:
        found = versions()
        if found != versions_wanted:
            # Compare the packages of this machine and the node, because either may lack one.
            names = (*versions_wanted, *found)
            name = next(key for key in names if found.get(key) != versions_wanted.get(key))
            there, here = (which.get(name, "none") for which in (found, versions_wanted))
            return pickle.dumps(
                _Unfit(
                    f"the node {node} has {name} {there}, but this machine has {here}: install "
                    "the same version there"
                )
            )
        module, function, arguments = pickle.loads(call)
        chosen = operator.attrgetter(function)(importlib.import_module(module))
        answer = chosen(*arguments)
    except MachineError as error:
        return pickle.dumps(_Unfit(f"the node {node} cannot run the work: {error}"))
    except ImportError as error:
        return pickle.dumps(
            _Unfit(f"the node {node} cannot import a module: {error}: install it there")
        )
    return pickle.dumps(answer)
