"""From where does a volume show most?

The entropy of an image says how evenly it is filled; its gradient by the camera's pose leads to views that show more.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
