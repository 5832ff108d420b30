"""Where batches come from: replay of rows and of sequences, and sources that mix them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
