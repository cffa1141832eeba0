from . import beginning as beginning
from . import config as config
from . import loop as loop
from . import reconstruction as reconstruction
from . import scalars as scalars
from .config import ScalarConfig as ScalarConfig
from .loop import ScalarResult as ScalarResult
from .loop import fit_scalar as fit_scalar

__all__ = ["ScalarConfig", "ScalarResult", "fit_scalar"]
