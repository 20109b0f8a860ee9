"""The thesis's two tasks: one or three tomatoes, a reward per view."""
