"""Makes positions, and the shots of a scene, free of intersections and collisions, and certifies it."""
