"""ONNX models and their manifests."""
