"""Training data: demonstrations, static scenes, labelled images."""
