import subprocess
import sys

import pytest

from kitting_drake.cell.cameras import can_render

RENDER_THEN_TRAIN = """
from pathlib import Path
import torch
from kitting_drake.cell.cell import build_cell
from kitting_drake.scenario.schema import Scenario

cell = build_cell(Scenario(), seed=0, base=Path())
cell.diagram.GetOutputPort("observation").Eval(cell.diagram.CreateDefaultContext())
torch.optim.Adam([torch.zeros(1, requires_grad=True)])
"""


@pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")
def test_an_optimizer_can_be_made_after_an_image_was_rendered():
    """As a person does who trains on a gymnasium environment: PyTorch's Triton and Mesa each bring
    an LLVM."""
    result = subprocess.run(
        [sys.executable, "-c", RENDER_THEN_TRAIN], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
