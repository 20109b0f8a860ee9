"""Training of the detectors: pictures, augmentation, presets, resumable loops."""
