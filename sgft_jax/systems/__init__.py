"""The real side of fine-tuning: what plays episodes, in simulation or on hardware."""
