"""How does a camera move through a film?

Splines through given cameras, turntables and ellipses, and files of them: always one pinhole camera for each frame.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
