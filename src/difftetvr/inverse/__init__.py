"""What is unknown where images are not photographs of it: where to look from, a transfer function.

Each room is one problem: what is unknown, what is measured, and the search. All of them stand on `render` and its
derivatives; reconstructions from images are `difftetvr.fitting`.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
