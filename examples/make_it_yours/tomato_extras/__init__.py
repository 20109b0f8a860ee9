"""What another package can add to maniskill-tomato: a task with its reward, a policy, a segmenter, plants, an arm and a
camera."""
