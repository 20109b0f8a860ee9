"""The arm and its camera: dimensions, limits and kinematics."""
