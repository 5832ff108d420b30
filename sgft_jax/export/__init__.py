"""Policies to take away: their graph, their folder, and the file in it that plays them alone."""
