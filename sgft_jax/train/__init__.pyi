from . import guard

__all__ = ["guard"]
