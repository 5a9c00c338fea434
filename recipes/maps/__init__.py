"""The kinds of maps that recipes know, and their figures."""
