"""The paper's experiments: the cells of its tables, the queue that fills them, their page."""
