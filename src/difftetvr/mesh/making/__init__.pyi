from . import conversion as conversion
from . import delaunay as delaunay
from . import delaunay_check as delaunay_check
from . import generators as generators
from . import lifting as lifting
from . import repair as repair
from . import surfaces as surfaces

__all__: list[str] = []
