"""One episode: running it, recording its actions, scoring it."""
