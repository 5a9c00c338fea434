"""What a run of any algorithm has around its loop."""
