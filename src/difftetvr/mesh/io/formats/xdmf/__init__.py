"""What do XDMF files look like?

A text in XML says which arrays are points, cells and data, and where they lie: in the text, in binary files, in HDF5.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
