"""What is decided of a pair: collisions of straight motions, minimum distances, those of a response, and arcs."""
