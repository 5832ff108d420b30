from . import dynamics, normalizer, ratio, value

__all__ = ["dynamics", "normalizer", "ratio", "value"]
