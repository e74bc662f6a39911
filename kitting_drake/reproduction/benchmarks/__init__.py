"""The measurements of the command `benchmark`, apart from networks and the paper."""
