"""A profile of the twin that many tests of the robot begin with: small pictures, and masks from the truth."""

TWIN_PROFILE = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
width = 160
height = 120
[perception]
segmenter = "ground_truth"
[target]
source = "twin"
"""
