"""Recordings of runs and demonstrations in the formats of other projects."""
