"""The robot's meshes and URDF, modelled from the numbers in `maniskill_tomato.robot`; not installed."""
