"""Fresh weights are the same in every test, and tests that run side by side share the cores."""

import pytest
import torch


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
