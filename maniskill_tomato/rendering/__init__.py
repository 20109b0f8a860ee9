"""Pictures by SAPIEN: plant actors, the rendered visible fraction, whether this machine can render."""
