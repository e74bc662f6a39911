"""escnn works without lie_learn and without a compiler.

These tests use a new process; `escnn_reference_test` uses escnn in the process of the tests.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from kitting_drake.policies.networks.layers.planar_escnn import gspaces

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


@pytest.mark.slow
def test_equivariant_layers_of_the_plane_work_in_a_new_process():
    command = [sys.executable, "-W", "error", "-c", EQUIVARIANT]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_groups_of_space_name_the_missing_package():
    with pytest.raises(NotImplementedError, match=r"escnn needs the package lie_learn for SO\(3\)"):
        gspaces.rot3dOnR3(maximum_frequency=1)
