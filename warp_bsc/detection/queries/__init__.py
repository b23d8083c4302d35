"""Elementary queries: arrays of points to answers, without a mesh."""
