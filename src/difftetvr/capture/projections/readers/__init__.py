"""What do files of projections look like, ours and those of other programs?

Whatever is announced is compared with the file's size, and with the memory that is free, before any is taken.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
