"""Simulation-Guided Fine-Tuning in JAX: learners, transforms, methods and training loops as pure functions.

docs/api.md lists what is here. A name is imported when it is first used (the stub beside this file says from where), so
that a program which only reads its command line starts neither JAX nor MuJoCo.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
