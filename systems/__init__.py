"""Drake LeafSystems of the kitting cell, one per file, and the signals that travel between them."""
