"""The typed YAML schema of a scenario, and its loader."""

from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.schema import Scenario

__all__ = ["Scenario", "load_scenario"]
