from . import memory, replay, sequences, sources

__all__ = ["memory", "replay", "sequences", "sources"]
