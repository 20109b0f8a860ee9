"""The tasks on plants of a greenhouse row that no policy has seen before."""
