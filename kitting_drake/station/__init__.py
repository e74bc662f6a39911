"""Builds the station of a scenario. All systems are wired together here."""

from kitting_drake.station.policy import connect_policy, make_policy, with_policy
from kitting_drake.station.station import KittingStation, build_station

__all__ = ["KittingStation", "build_station", "connect_policy", "make_policy", "with_policy"]
