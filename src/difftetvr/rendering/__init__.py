"""From camera and mesh to an image and back: what is the radiance of each pixel, and what is its derivative?

Cameras make rays (`cameras`), tracers find the cells that they cross in order (`tracers`), each crossing is described
(`traversal`), and kernels gather something from them (`kernels`): light, derivatives, what a finer mesh would win.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
