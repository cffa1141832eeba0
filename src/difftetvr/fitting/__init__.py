"""From images to a tetrahedral volume: what is optimised, how, and for how long?

The loop, its losses, the steps of vertices and what several processes share stand here; inner rooms hold what a run
begins with (`beginning`), how its mesh refines itself (`refinement`) and what it leaves (`records`).
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
