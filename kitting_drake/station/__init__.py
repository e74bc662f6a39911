"""From a scenario to its station: the only place where systems are wired together."""

from kitting_drake.station.policy import connect_policy, make_policy, with_policy
from kitting_drake.station.station import KittingStation, build_station

__all__ = ["KittingStation", "build_station", "connect_policy", "make_policy", "with_policy"]
