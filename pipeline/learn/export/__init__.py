"""A trained network as one ONNX file, with its card."""
