"""From a scenario to the Diagram of the cell: the only place where systems are wired together."""

from kitting_drake.station.station import Cell, build_cell

__all__ = ["Cell", "build_cell"]
