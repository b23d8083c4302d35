"""Detection in one configuration: intersections, containment, and pairs that are near."""
