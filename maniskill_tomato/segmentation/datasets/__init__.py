"""Annotated images on disk: COCO and Pascal VOC."""
