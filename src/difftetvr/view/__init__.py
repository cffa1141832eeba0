"""Where do results go: pictures, cuts, plots, tables, reports?

It shows what the other rooms made and changes nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
