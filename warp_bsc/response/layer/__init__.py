"""A layer around surfaces in which contacts push gradually."""
