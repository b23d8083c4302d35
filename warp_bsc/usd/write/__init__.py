"""USD layers with positions of points that a program computed."""
