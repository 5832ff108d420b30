"""What runs and rolls in a vertical plane: HalfCheetah, Walker2d, a wheel-legged robot."""
