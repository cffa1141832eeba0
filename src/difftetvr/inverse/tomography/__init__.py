"""Densities from projections: what a tomograph measures, on a mesh that moves and refines itself."""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
