"""The paper's experiments: the cells of its tables, the queue that runs them, and their page."""
