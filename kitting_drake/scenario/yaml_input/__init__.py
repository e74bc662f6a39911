"""Parses YAML and checks it against a schema of dataclasses."""
