"""How does a scalar look of which nothing is said but its name?

Its distribution in space, and what follows from it: a range, colours, and opacities with which its structure is seen.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
