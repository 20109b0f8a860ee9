"""The digital twin: a simulated arm and camera."""
