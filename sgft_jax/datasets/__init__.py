"""Recorded data: reading, writing, layouts of others."""
