"""The KUKA iiwa through the LibIiwa application on its controller."""
