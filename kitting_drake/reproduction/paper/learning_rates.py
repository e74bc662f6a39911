"""The learning rates of the baselines: the file of what each came to on validation scenes."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_json

RATES = "learning_rates.json"
"""The file, beside the results."""

Rates = Mapping[str, Mapping[str, float]]
"""For each task and method (`rates_key`) and for each learning rate, the criterion of a checkpoint
on validation scenes: the cost in mm, on a Ravens task the loss in nats. It is infinite where
training diverged, which the file has as null."""


def read_rates(folder: Path) -> dict[str, dict[str, float]]:
    """The learning rates that have been tried; none where there is no file.

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
            raise ValueError("a method without any rate")
        return rates
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged: delete it") from error


def write_rates(folder: Path, rates: Rates) -> None:
    """Writes what `read_rates` reads.

    Raises:
        UserError: the file cannot be written.
    """
    content = {
        key: {rate: cost if math.isfinite(cost) else None for rate, cost in costs.items()}
        for key, costs in sorted(rates.items())
    }
    write_json(folder / RATES, content)


def best_rate(costs: Mapping[str, float]) -> str:
    """The learning rate at which a method does best."""
    return min(costs, key=lambda rate: costs[rate])
