"""Policies that choose the next viewpoint: planners, learned ones, exported ones."""
