"""Estimators of the visible fraction from an image with depth and masks."""
