"""YAML: parsed, and checked against a schema of dataclasses."""
