"""Training: losses, steps, runs that resume, validation, export."""
