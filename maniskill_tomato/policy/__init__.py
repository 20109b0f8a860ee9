"""Trained policies away from the trainer: needs NumPy and ONNX Runtime, neither PyTorch nor ManiSkill."""
