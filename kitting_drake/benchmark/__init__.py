"""What things cost on this machine: the command `benchmark`."""
