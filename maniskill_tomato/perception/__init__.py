"""From pixels to how much of the target is seen: datasets, segmenters, occlusion models and their measures."""
