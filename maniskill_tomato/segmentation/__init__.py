"""Finding fruits in images: detectors, their data sets, training and metrics."""
