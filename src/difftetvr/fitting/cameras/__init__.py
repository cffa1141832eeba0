"""Where did the cameras of photographs really stand? Poses and intrinsics as unknowns of a fit."""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
