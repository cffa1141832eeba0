"""Differentiable volume rendering of tetrahedral meshes.

From a mesh with colour and density and a camera to an image, and from the derivative of a loss on that image back to
colours, densities, transfer functions, vertex positions and camera poses; from images to a tetrahedral volume.

    import difftetvr as dtv
    image = dtv.render(mesh, dtv.Field(color, density), camera)
    result = dtv.fit(dtv.load_capture("photos"), dtv.FitConfig(cells=100_000))

Names load when they are first used, so that importing the package, and asking the command line for help, costs no
import of PyTorch; ``EAGER_IMPORT=1`` in the environment loads all at once.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
