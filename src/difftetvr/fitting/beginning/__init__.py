"""What does a reconstruction begin with, and can it begin at all?

Meshes made for what the images show, meshes from files, and checks of images, options and device.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
