"""What nets, learners and analysis share: losses, optimisers, statistics."""
