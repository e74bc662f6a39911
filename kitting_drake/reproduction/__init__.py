"""The command `benchmark`, with measurements on this machine, and the page of results."""
