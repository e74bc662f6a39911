import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kitting_drake.common.errors import MachineError
from kitting_drake.common.processes import (
    LocalWorkers,
    ProcessCrashed,
    run_in_subprocess,
    side_by_side,
)

ROOT = Path(__file__).resolve().parents[3]


def add(a: int, b: int) -> int:
    return a + b


def process_and_threads() -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


def kill_itself() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def leave() -> None:
    sys.exit(3)


def lack_room() -> None:
    raise MachineError("cannot write: No space left on device")


def test_a_machine_error_is_raised_in_the_parent():
    with LocalWorkers(1) as workers:
        with pytest.raises(MachineError, match="No space left"):
            workers.run(lack_room)
        assert workers.run(add, 2, 3) == 5


def test_a_call_returns_the_result_of_another_process():
    process, _ = run_in_subprocess(process_and_threads)
    assert process != os.getpid()


def test_a_dead_process_is_reported_without_other_effects():
    assert run_in_subprocess(kill_itself) == ProcessCrashed(-signal.SIGKILL)
    assert run_in_subprocess(leave) == ProcessCrashed(3)


def test_processes_are_reused_up_to_a_limit_and_not_after_a_crash():
    with LocalWorkers(1) as workers:
        found = [workers.run(os.getpid) for _ in range(12)]
        assert len(set(found[:10])) == 1
        assert len({*found[9:11]}) == 2
        assert workers.run(kill_itself) == ProcessCrashed(-signal.SIGKILL)
        last = workers.run(os.getpid)
        assert last not in found
    assert command(last) == ""
    # Outside of a `with`, processes are not reused: nothing would end them.
    assert len({workers.run(os.getpid) for _ in range(2)}) == 2


@pytest.mark.parametrize(
    ("count", "threads"), [(2, "1"), pytest.param(1, "7", marks=pytest.mark.slow)]
)
def test_parallel_processes_use_one_thread_each(
    count: int, threads: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    items = iter([0])
    with LocalWorkers(count) as workers:
        ((_, found),) = side_by_side(
            lambda _: workers.run(process_and_threads), lambda: next(items, None), workers=workers
        )
    assert found == threads
    assert os.environ["OMP_NUM_THREADS"] == "7"


class Growing(LocalWorkers):
    """Workers that can run one call at a time at first, later two at a time."""

    def __init__(self) -> None:
        super().__init__(1)
        self.asked = 0

    def capacity(self) -> int:
        self.asked += 1
        return min(self.asked, 2)


@pytest.mark.parametrize("workers", [LocalWorkers(2), Growing()])
def test_side_by_side_draws_again_after_every_result(workers: LocalWorkers):
    wanted, given, most = {0, 1, 2}, [], []

    def draw() -> int | None:
        number = len(given)
        if number not in wanted:
            return None
        given.append(number)
        most.append(len(given) - len(ended))
        return number

    def work(item: int) -> int:
        time.sleep(0.01)
        return item

    ended: list[int] = []
    for item in side_by_side(work, draw, workers=workers):
        ended.append(item)
        if item == 2:
            wanted |= {3}
    assert sorted(ended) == [0, 1, 2, 3]
    assert max(most) == 2


def test_ending_early_kills_running_calls():
    items = iter([60.0, 0.0])
    workers = LocalWorkers(2)

    def sleep_again_if_killed(seconds: float) -> None:
        while workers.run(time.sleep, seconds) == ProcessCrashed(-signal.SIGKILL):
            if workers.run(time.sleep, seconds) is not None:
                break

    start = time.monotonic()
    for _ in side_by_side(sleep_again_if_killed, lambda: next(items, None), workers=workers):
        break
    assert time.monotonic() - start < 30.0
    assert workers.run(time.sleep, 60.0) == ProcessCrashed(-signal.SIGKILL)


_PROGRAM = """
import sys, time
from kitting_drake.common.processes import run_in_subprocess

if __name__ == "__main__":
    run_in_subprocess(time.sleep, 60)
"""


def test_child_processes_end_with_a_killed_parent(tmp_path: Path):
    program = tmp_path / "parent.py"
    program.write_text(_PROGRAM)
    parent = subprocess.Popen([sys.executable, program], env=os.environ | {"PYTHONPATH": str(ROOT)})
    children: list[int] = []
    while not children:
        time.sleep(0.02)
        listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        # The other child is multiprocessing's resource tracker.
        children = [pid for pid in map(int, listed) if "spawn_main" in command(pid)]
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 30.0
    while any("spawn_main" in command(pid) for pid in children):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except FileNotFoundError:
        return ""
