from . import replay, sequences, sources

__all__ = ["replay", "sequences", "sources"]
