"""From a scenario to the Diagram of the cell."""
