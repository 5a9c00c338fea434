"""A task, a map and an algorithm of one's own."""
