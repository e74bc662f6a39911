"""A Ray cluster as `Workers`. Ray is needed here alone, and only when it is asked for."""

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
"""How often a call is begun again when its node, or its worker there, dies."""

_PATIENCE = 5.0
"""How long to wait for an answer from the cluster's address, in s."""


@dataclass(frozen=True)
class _Unfit:
    """The answer of a node that cannot do the work."""

    reason: str


class RayWorkers:
    """The CPUs of a Ray cluster, as `Workers`; to be used in a `with`.

    A call occupies one CPU. There it runs in a fresh process, as it would here; when its node
    dies, it runs again on another. Results come back to this process, which alone writes files.
    """

    def __init__(self, address: str, runtime_env: dict[str, Any]) -> None:
        """
        Args:
            address: `auto`, `HOST:PORT` or `ray://HOST:PORT`.
            runtime_env: Ray's, of the processes there; in its `working_dir` is this package.
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
            UserError: Ray is not installed, there is no such cluster, or it refuses the files.
        """
        # When a node dies, Ray prints why; without this, pages of that node's log, too.
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
            raise UserError(f"a node of the cluster cannot work: {last_line}") from error
        except exceptions.RayError:
            # Its nodes died again and again, or it was cancelled.
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
    """The address of a cluster that answers. Where none does, Ray itself would try for minutes.

    Raises:
        UserError: nothing answers at the address, or this machine has no cluster.
    """
    found = address
    if address == "auto":
        services = importlib.import_module("ray._private.services")
        try:
            found = services.get_ray_address_from_environment("auto", None)
        except ConnectionError as error:
            raise UserError(
                "--ray auto: there is no cluster on this machine: start one as docs/cluster.md says"
            ) from error
    host, _, port = found.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise UserError(f"--ray takes auto, HOST:PORT or ray://HOST:PORT, not '{found}'")
    try:
        socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"--ray {address}: there is no cluster at {host}:{port} ({reason}): start one as "
            "docs/cluster.md says"
        ) from error
    return found


def _name(function: Callable[..., object]) -> tuple[str, str]:
    """The module and the name by which another process imports a function."""
    module = function.__module__
    if module == "__main__":
        # Started by `python -m`: elsewhere it is not the main module.
        module = sys.modules["__main__"].__spec__.name  # type: ignore[union-attr]
    return module, function.__qualname__


def _serve(versions_wanted: dict[str, str], call: bytes) -> bytes | ProcessCrashed:
    """Runs a call in a worker of a node. It reads neither the call nor the result, and so imports
    nothing that is not needed to pass them on."""
    return run_in_subprocess(_answer, versions_wanted, call)


def _answer(versions_wanted: dict[str, str], call: bytes) -> bytes:
    """Runs a call in the fresh process of a node: a pickled result, or `_Unfit`."""
    node = platform.node()
    try:
        found = versions()
        if found != versions_wanted:
            # A package that is not installed has no version.
            names = (*versions_wanted, *found)
            name = next(key for key in names if found.get(key) != versions_wanted.get(key))
            there, here = (which.get(name, "none") for which in (found, versions_wanted))
            return pickle.dumps(
                _Unfit(
                    f"the node {node} has {name} {there}, this machine {here}: install the same "
                    "there"
                )
            )
        module, function, arguments = pickle.loads(call)
        chosen = operator.attrgetter(function)(importlib.import_module(module))
        answer = chosen(*arguments)
    except MachineError as error:
        return pickle.dumps(_Unfit(f"the node {node} cannot work: {error}"))
    except ImportError as error:
        return pickle.dumps(
            _Unfit(f"the node {node} cannot import what it needs: {error}: install it there")
        )
    return pickle.dumps(answer)
