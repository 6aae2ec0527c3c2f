"""CADENCE: diffusion models for sparse, adversarial multi-target tracking. Pure torch and numpy; no files, no clocks.

What is public stands in `__init__.pyi`; it is imported when it is first used, since torch takes seconds.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
