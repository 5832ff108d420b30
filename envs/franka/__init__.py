"""The Franka Research 3 tasks: hammering, pushing, insertion."""
