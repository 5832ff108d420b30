"""Which simulated systems may have made real rollouts, and which policy is best to deploy in them."""
