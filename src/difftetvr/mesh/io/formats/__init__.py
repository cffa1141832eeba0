"""What does each format of mesh files look like?

A file a format, named after it; `table` says which suffix is whose.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
