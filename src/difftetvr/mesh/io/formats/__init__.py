"""What does each format of mesh files look like?

A file a format, named after it; `table` says which suffix is whose.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
