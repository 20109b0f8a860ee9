"""How much of a fruit a camera sees."""
