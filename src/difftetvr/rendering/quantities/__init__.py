"""What else is known of a ray: where its light is half gone, how much gets how far, and which way matter faces?"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
