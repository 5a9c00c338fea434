"""YAML choices of one's own."""
