"""Shared code: files, processes, errors, paths, command lines."""
