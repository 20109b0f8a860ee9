"""The wrist camera in the flange frame: ChArUco board, hand-eye calibration, its residuals and its file."""
