"""The Intel RealSense D435 through librealsense, live or from a recording."""
