"""What does each format of volume files look like?

A file a format; whatever is announced is compared with the file's size before memory is taken.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
