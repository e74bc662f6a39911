"""What decides by looking: demonstrations to learn from, networks, losses. No pydrake here."""
