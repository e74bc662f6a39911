"""The command `benchmark`: measurements on this machine."""
