"""The typed YAML schema of a scenario, and its loader."""
