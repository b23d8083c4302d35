"""Device functions of the pipeline: queues, boxes, and the culls and trees of a CPU's vector instructions."""
