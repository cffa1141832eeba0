from . import config as config
from . import fit as fit
from . import knots as knots
from . import volumes as volumes
from .config import TransferConfig as TransferConfig
from .fit import TransferProgress as TransferProgress
from .fit import TransferResult as TransferResult
from .fit import fit_transfer as fit_transfer
from .volumes import volume_on_grid as volume_on_grid

__all__ = ["TransferConfig", "TransferProgress", "TransferResult", "fit_transfer", "volume_on_grid"]
