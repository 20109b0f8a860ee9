"""Imitation of a teacher that knows the truth by a student that does not (behaviour cloning, DAgger)."""
