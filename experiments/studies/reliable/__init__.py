"""What `experiments.studies.reliability` does to a run on a simulated robot, and how it finds out what became of it."""
