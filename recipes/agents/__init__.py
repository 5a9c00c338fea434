"""The algorithms: settings, networks and loss of each."""
