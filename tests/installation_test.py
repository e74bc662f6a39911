"""escnn works without lie_learn and without a compiler."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

EQUIVARIANT = """
import torch
from kitting_drake.policies.networks.layers.planar_escnn import enn, gspaces

space = gspaces.rot2dOnR2(N=-1, maximum_frequency=3)
scalar = enn.FieldType(space, [space.trivial_repr])
vector = enn.FieldType(space, [space.irrep(1)])
torch.manual_seed(0)
image = torch.randn(1, 1, 9, 9)
layer = enn.R2Conv(scalar, vector, kernel_size=3)
straight = layer(scalar(image)).tensor
turned = layer(scalar(torch.rot90(image, 1, (2, 3)))).tensor
back = torch.rot90(turned, -1, (2, 3))
expected = torch.stack([back[0, 1], -back[0, 0]])
assert torch.allclose(straight[0], expected, atol=1e-5)
"""

SOLID = """
space = gspaces.rot3dOnR3(maximum_frequency=1)
space.irrep(1)(space.fibergroup.element((0.1, 0.2, 0.3), "ZYZ"))
"""


@pytest.fixture(scope="module")
def done() -> subprocess.CompletedProcess[str]:
    """Runs both programs in a new process, where escnn is not imported yet."""
    program = f"{EQUIVARIANT}\nprint('works')\n{SOLID}"
    command = [sys.executable, "-W", "error", "-c", program]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_equivariant_layers_of_the_plane_work(done: subprocess.CompletedProcess[str]):
    assert done.stdout == "works\n", done.stderr


def test_groups_of_space_name_the_missing_package(done: subprocess.CompletedProcess[str]):
    assert done.returncode == 1
    assert "NotImplementedError: escnn needs the package lie_learn for SO(3)" in done.stderr
