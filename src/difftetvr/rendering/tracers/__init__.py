"""Which cells does a ray cross, in which order?

Three answers, the article's two and the walk: `marching`, `linked_list`, `projected`, and what they are built from.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
