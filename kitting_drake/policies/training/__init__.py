"""Training: steps, runs that resume, validation, export to ONNX."""
