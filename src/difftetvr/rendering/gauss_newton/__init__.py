"""What would measurements gain if the mesh were finer or cut otherwise? Quadratic models of their squared error."""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
