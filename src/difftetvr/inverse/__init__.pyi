from . import scalars as scalars
from . import tomography as tomography
from . import transfer as transfer
from . import variation as variation
from . import viewpoint as viewpoint
from .scalars.config import ScalarConfig as ScalarConfig
from .scalars.loop import ScalarResult as ScalarResult
from .scalars.loop import fit_scalar as fit_scalar
from .transfer.config import TransferConfig as TransferConfig
from .transfer.fit import TransferProgress as TransferProgress
from .transfer.fit import TransferResult as TransferResult
from .transfer.fit import fit_transfer as fit_transfer
from .transfer.volumes import volume_on_grid as volume_on_grid
from .viewpoint.entropy import color_entropy as color_entropy
from .viewpoint.entropy import opacity_entropy as opacity_entropy
from .viewpoint.entropy import reference_colors as reference_colors
from .viewpoint.record import Viewpoint as Viewpoint
from .viewpoint.search import ViewpointConfig as ViewpointConfig
from .viewpoint.search import ViewpointSearch as ViewpointSearch
from .viewpoint.search import best_viewpoint as best_viewpoint
from .viewpoint.search import sample_viewpoints as sample_viewpoints

__all__ = [
    "ScalarConfig",
    "ScalarResult",
    "TransferConfig",
    "TransferProgress",
    "TransferResult",
    "Viewpoint",
    "ViewpointConfig",
    "ViewpointSearch",
    "best_viewpoint",
    "color_entropy",
    "fit_scalar",
    "fit_transfer",
    "opacity_entropy",
    "reference_colors",
    "sample_viewpoints",
    "volume_on_grid",
]
