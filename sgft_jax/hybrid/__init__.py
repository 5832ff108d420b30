"""One policy from a fixed set of real data and an imperfect simulator; the real system is not touched."""
