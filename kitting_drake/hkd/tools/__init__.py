"""Hand tools: their families, generation and records."""
