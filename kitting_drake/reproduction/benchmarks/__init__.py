"""The measurements of `benchmark` that do not concern networks or the paper's tables."""
