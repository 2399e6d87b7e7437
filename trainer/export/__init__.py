"""Deployable artifacts: ONNX and TorchScript, with measured parity."""
