"""Reads and writes the file of the baselines' learning rates, with their costs on validation
scenes."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_json

RATES = "learning_rates.json"
"""The name of the file, which is beside the results."""

Rates = Mapping[str, Mapping[str, float]]
"""Maps the key of a training (`rates_key`) and a learning rate to the cost on validation scenes.
The cost is a displacement in mm; on a Ravens task it is the loss in nats. It is infinite (null in
the file) if the training diverged."""


def read_rates(folder: Path) -> dict[str, dict[str, float]]:
    """Returns the costs of the learning rates that have been tried; empty if there is no file.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / RATES
    try:
        found = json.loads(path.read_text()) if path.exists() else {}
        rates = {
            key: {
                str(rate): math.inf if cost is None else float(cost) for rate, cost in costs.items()
            }
            for key, costs in found.items()
        }
        if not all(rates.values()):
            raise ValueError("a method has no rates")
        return rates
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged: delete it") from error


def write_rates(folder: Path, rates: Rates) -> None:
    """Writes the file of `read_rates`.

    Raises:
        MachineError: the file cannot be written.
    """
    content = {
        key: {rate: cost if math.isfinite(cost) else None for rate, cost in costs.items()}
        for key, costs in sorted(rates.items())
    }
    write_json(folder / RATES, content)


def best_rate(costs: Mapping[str, float]) -> str:
    """Returns the learning rate with the least cost."""
    return min(costs, key=lambda rate: costs[rate])
