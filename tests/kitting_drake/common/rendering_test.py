import multiprocessing
import subprocess
import sys
from multiprocessing.connection import Connection

import pytest

from kitting_drake.common.errors import MachineError
from kitting_drake.common.rendering import can_render, require_rendering

pytestmark = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")

RENDER_THEN_TRAIN = """
import torch
from kitting_drake.scenario import Scenario
from kitting_drake.station import build_station

station = build_station(Scenario())
station.GetOutputPort("observation").Eval(station.CreateDefaultContext())
torch.optim.Adam([torch.zeros(1, requires_grad=True)])
"""


@pytest.mark.slow
def test_an_optimizer_can_be_made_after_rendering():
    """PyTorch's Triton and Mesa each load an LLVM, and the two must not clash."""
    result = subprocess.run(
        [sys.executable, "-c", RENDER_THEN_TRAIN], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def tell_refusal(connection: Connection) -> None:
    try:
        require_rendering()
    except MachineError as error:
        connection.send(str(error))
    else:
        connection.send("nothing")


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("start", "refusal"), [("fork", "this process was forked"), ("spawn", "nothing")]
)
def test_a_fork_of_a_process_that_rendered_raises(start: str, refusal: str):
    """The forked process would deadlock, because it waits for threads that only its parent has."""
    require_rendering()
    context = multiprocessing.get_context(start)
    here, there = context.Pipe()
    process = context.Process(target=tell_refusal, args=(there,))
    process.start()
    assert here.recv().startswith(refusal)
    process.join()
