"""The layers that the equivariant networks are built of."""
