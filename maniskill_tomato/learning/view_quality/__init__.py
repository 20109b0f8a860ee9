"""Learning how good views are: a network that says, for every candidate viewpoint round the target, how much of it will be seen."""
