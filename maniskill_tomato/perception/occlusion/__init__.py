"""How much of each detected tomato is visible, from a colour image, a depth image and the tomatoes' masks."""
