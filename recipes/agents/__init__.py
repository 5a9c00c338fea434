"""A module for each algorithm (its settings, networks and loss), and modules for what several of them share."""
