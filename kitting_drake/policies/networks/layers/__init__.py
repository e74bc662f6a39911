"""The layers of the equivariant networks."""
