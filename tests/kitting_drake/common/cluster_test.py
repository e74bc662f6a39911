"""`RayWorkers` with a fake Ray. `tests/kitting_drake/ray_cluster_test.py` uses a real cluster."""

import functools
import os
import pickle
import signal
import socket
import sys
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import kitting_drake.common.cluster as cluster
from kitting_drake.common.cluster import RayWorkers
from kitting_drake.common.errors import UserError
from kitting_drake.common.processes import ProcessCrashed
from kitting_drake.common.provenance import versions

RUNTIME_ENV = {"working_dir": "folder", "env_vars": {"HERE": "there"}}
KILLED = ProcessCrashed(-signal.SIGKILL)


class FakeRay(types.ModuleType):
    """The part of Ray that is used. A task runs when its result is requested."""

    class exceptions:  # noqa: N801
        class RayError(Exception): ...

        class RayTaskError(RayError): ...

        class RuntimeEnvSetupError(RayError): ...

    def __init__(self) -> None:
        super().__init__("ray")
        self.address = ""
        self.options: dict[str, Any] = {}
        self.cpus: dict[str, float] = {"CPU": 3.0}
        self.error: Exception | None = None
        self.begun, self.cancelled = threading.Event(), threading.Event()
        self.waits = False

    def init(self, **options: Any) -> None:
        self.options = options
        if self.error is not None:
            raise self.error

    def shutdown(self) -> None: ...

    def cluster_resources(self) -> dict[str, float]:
        return self.cpus

    def remote(self, **_: Any) -> Callable[..., Any]:
        return lambda function: types.SimpleNamespace(
            remote=lambda *arguments: functools.partial(function, *arguments)
        )

    def get(self, task: Callable[[], Any]) -> Any:
        if self.waits:
            self.begun.set()
            assert self.cancelled.wait(30.0)
            raise self.exceptions.RayError
        if self.error is not None:
            raise self.error
        return task()

    def cancel(self, _: object, *, force: bool) -> None:
        self.cancelled.set()


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeRay]:
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setitem(
        sys.modules,
        "ray._private.services",
        types.SimpleNamespace(get_ray_address_from_environment=lambda *_: fake.address),
    )
    with socket.create_server(("127.0.0.1", 0)) as head:
        fake.address = f"127.0.0.1:{head.getsockname()[1]}"
        yield fake


def workers(address: str = "auto") -> RayWorkers:
    return RayWorkers(address, RUNTIME_ENV)


def test_a_call_runs_in_its_own_process(ray: FakeRay):
    with workers() as there:
        assert there.run(os.getpid) not in (os.getpid(), None)
        assert there.run(os._exit, 3) == ProcessCrashed(3)
    assert ray.options["runtime_env"] == RUNTIME_ENV


def test_capacity_is_the_number_of_cpus(ray: FakeRay):
    with workers() as there:
        assert there.capacity() == 3
        # A cluster without CPUs may grow, but only once a task waits: allow one task.
        ray.cpus = {}
        assert there.capacity() == 1


def test_a_lost_call_counts_as_killed(ray: FakeRay):
    with workers() as there:
        ray.error = ray.exceptions.RayError("its nodes died, again and again")
        assert there.run(os.getpid) == KILLED


def test_a_worker_that_cannot_start_raises(ray: FakeRay):
    with workers() as there:
        ray.error = ray.exceptions.RayTaskError("A traceback\nNo module named 'rich'")
        with pytest.raises(UserError, match="No module named 'r"):
            there.run(os.getpid)


def test_stop_cancels_running_calls(ray: FakeRay):
    found: list[object] = []
    with workers() as there:
        ray.waits = True
        thread = threading.Thread(target=lambda: found.append(there.run(os.getpid)))
        thread.start()
        assert ray.begun.wait(30.0)
        there.stop()
        thread.join()
        assert found == [KILLED]
        assert there.run(os.getpid) == KILLED


def test_an_error_names_a_node_with_other_versions(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("platform.node", lambda: "second")
    wanted = versions() | {"drake": "0.1"}
    outcome = pickle.loads(cluster._answer(wanted, pickle.dumps(("os", "getpid", ()))))
    assert f"node second has drake {versions()['drake']}" in outcome.reason


def test_an_error_names_a_package_without_a_version():
    """An episode must not count as failed because a node lacks a package."""
    wanted = {**versions(), "absent": "1.2"}
    outcome = pickle.loads(cluster._answer(wanted, pickle.dumps(("os", "getpid", ()))))
    assert "absent" in outcome.reason


def test_an_error_names_a_node_without_a_package(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("platform.node", lambda: "second")
    call = pickle.dumps(("no_such_module", "work", ()))
    outcome = pickle.loads(cluster._answer(versions(), call))
    assert outcome.reason.startswith("the node second ")
    assert "No module named 'no_such_module'" in outcome.reason


def test_an_error_names_a_node_that_lacks_something(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("platform.node", lambda: "second")
    (tmp_path / "file").touch()
    call = ("kitting_drake.common.files", "require_folder", (tmp_path / "file" / "folder",))
    outcome = pickle.loads(cluster._answer(versions(), pickle.dumps(call)))
    assert outcome.reason.startswith("the node second cannot run the work: cannot write into ")


def test_a_function_of_the_main_module_is_importable(monkeypatch: pytest.MonkeyPatch):
    main = types.ModuleType("__main__")
    main.__spec__ = types.SimpleNamespace(name="kitting_drake.collect")  # type: ignore[assignment]
    monkeypatch.setitem(sys.modules, "__main__", main)

    def work() -> None: ...

    work.__module__, work.__qualname__ = "__main__", "work"
    assert cluster._name(work) == ("kitting_drake.collect", "work")


def test_missing_ray_raises_user_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match="pip install 'ray"):
        workers().__enter__()


@pytest.mark.parametrize("address", ["local", "here:", ":6379", "here:port"])
def test_an_invalid_address_raises(address: str, ray: FakeRay):
    with pytest.raises(UserError, match=f"HOST:PORT .*'{address}'"):
        workers(address).__enter__()


@pytest.mark.parametrize("prefix", ["", "ray://"])
def test_an_address_without_a_cluster_raises(prefix: str, ray: FakeRay):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    with pytest.raises(UserError, match=rf"127.0.0.1:{port} \(Connection re"):
        workers(f"{prefix}127.0.0.1:{port}").__enter__()


def test_an_outdated_cluster_address_raises(ray: FakeRay):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        # As after a power failure: Ray still has the address of the last cluster.
        ray.address = f"127.0.0.1:{listener.getsockname()[1]}"
    with pytest.raises(UserError, match=f"--ray auto: .*{ray.address}"):
        workers().__enter__()


@pytest.mark.parametrize("error", [ConnectionError, FakeRay.exceptions.RuntimeEnvSetupError])
def test_a_cluster_that_rejects_the_files_raises(error: type[Exception], ray: FakeRay):
    ray.error = error("It is too large.\nAnd more.")
    with pytest.raises(UserError, match=r"^--ray auto: .*: It is too large\.$"):
        workers().__enter__()
