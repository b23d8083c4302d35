"""What a step found and did: results, totals, results by world, contacts and impulses, and drawings."""
