"""From swept boxes to pairs of elements: trees, their traversal, and the pairs of elements of pairs of faces."""
