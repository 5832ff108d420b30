"""Which system is this? Candidates replay what the real one did; the posterior says which policy to deploy."""
