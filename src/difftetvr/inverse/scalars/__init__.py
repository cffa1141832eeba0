"""From images to the scalar field of a mesh that moves and refines itself, behind a transfer function."""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
