"""Files in, files out: the only layer that knows paths, MCAP, Arrow, wall clocks and processes.

What is public stands in `__init__.pyi`; it is imported when it is first used, so that `cadence --help` answers at once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
