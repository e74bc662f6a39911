"""The paper's experiments: the cells of its tables, and the queue that fills them."""
