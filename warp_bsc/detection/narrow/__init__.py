"""From pairs of elements to contacts: culls, classification, times of impact, and the buffer of contacts."""
