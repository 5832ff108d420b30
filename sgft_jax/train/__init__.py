"""Training: in simulation, on the real system, and what chooses policies."""
