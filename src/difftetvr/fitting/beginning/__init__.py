"""What does a reconstruction begin with, and can it begin at all?

Meshes made for what the images show, meshes from files, and checks of images, options and device.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
