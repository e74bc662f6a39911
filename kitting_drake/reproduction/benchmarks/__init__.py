"""The measurements of the command `benchmark`, except for those of networks and the paper."""
