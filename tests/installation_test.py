"""What the set-up promises to the policies: torch and escnn, without a Fortran compiler."""

import subprocess
import sys

_PROGRAM = """
import torch
from escnn import gspaces, nn

space = gspaces.rot2dOnR2(N=-1, maximum_frequency=3)
scalar = nn.FieldType(space, [space.trivial_repr])
vector = nn.FieldType(space, [space.irrep(1)])
torch.manual_seed(0)
image = torch.randn(1, 1, 9, 9)
layer = nn.R2Conv(scalar, vector, kernel_size=3)
straight = layer(scalar(image)).tensor
turned = layer(scalar(torch.rot90(image, 1, (2, 3)))).tensor
back = torch.rot90(turned, -1, (2, 3))
expected = torch.stack([back[0, 1], -back[0, 0]])
assert torch.allclose(straight[0], expected, atol=1e-5)
"""


def test_escnn_works_as_it_was_installed():
    # In a process of its own: torch is slow to load, and no other test needs it.
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
