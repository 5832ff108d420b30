"""What `experiments.benchmark` measures, each next to its reference from the same run."""
