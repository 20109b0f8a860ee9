"""Rendered training images of tomato rows with exact annotations."""
