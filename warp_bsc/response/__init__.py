"""Newton: the collision stage, which makes the motion of a solver free of collisions. Newton is imported only here."""
