"""Policies that are not trained by reinforcement: baselines, published planners, and those that know the truth."""
