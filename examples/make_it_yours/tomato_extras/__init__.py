"""What another package can add to maniskill-tomato: a policy, a segmenter and a generator of plants."""
