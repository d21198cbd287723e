"""The whole model: fit, control, read-out and checkpoints."""
