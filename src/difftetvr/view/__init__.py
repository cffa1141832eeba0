"""Where do results go: pictures, cuts, plots, tables, reports?

It shows what the other rooms made and changes nothing.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
