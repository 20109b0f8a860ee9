"""The digital twin: an arm and a camera that exist only in numbers."""
