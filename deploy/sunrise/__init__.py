"""The KUKA iiwa through the Sunrise Toolbox server on its controller."""
