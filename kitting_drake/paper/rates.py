"""The learning rates of the baselines: the file of what each came to on validation scenes."""

import json
from collections.abc import Mapping
from pathlib import Path

from kitting_drake.common.errors import UserError

RATES = "learning_rates.json"
"""The file, beside the results."""

Rates = Mapping[str, Mapping[str, float]]
"""For each method and learning rate, the displacement on validation scenes in mm."""


def read_rates(folder: Path) -> dict[str, dict[str, float]]:
    """The learning rates that have been tried; none where there is no file.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / RATES
    try:
        found = json.loads(path.read_text()) if path.exists() else {}
        return {
            method: {str(rate): float(cost) for rate, cost in costs.items()}
            for method, costs in found.items()
        }
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged: delete it") from error


def best_rate(costs: Mapping[str, float]) -> str:
    """The learning rate at which a method does best."""
    return min(costs, key=lambda rate: costs[rate])
