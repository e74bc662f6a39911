"""Shared by the whole application: files, processes, errors, paths, command lines."""
