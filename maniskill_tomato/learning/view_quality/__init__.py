"""Learning how much of the target will be seen from every candidate viewpoint, by what the simulator knows."""
