from . import alignment as alignment
from . import config as config
from . import densities as densities
from . import judgement as judgement
from . import likelihoods as likelihoods
from . import loop as loop
from . import measurements as measurements
from . import objective as objective
from . import reconstruction as reconstruction
from . import scoring as scoring
from . import solver as solver
from .alignment import Alignment as Alignment
from .config import TomographyConfig as TomographyConfig
from .loop import TomographyResult as TomographyResult
from .loop import reconstruct as reconstruct
from .scoring import ProjectionScore as ProjectionScore

__all__ = ["Alignment", "ProjectionScore", "TomographyConfig", "TomographyResult", "reconstruct"]
