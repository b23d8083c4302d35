"""The intervals of a scene: their contacts, what they sum up to, and the files that tell of them."""
