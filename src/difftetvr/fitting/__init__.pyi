from . import beginning as beginning
from . import cameras as cameras
from . import config as config
from . import loop as loop
from . import losses as losses
from . import metrics as metrics
from . import motion as motion
from . import options as options
from . import parameters as parameters
from . import positions as positions
from . import processes as processes
from . import records as records
from . import refinement as refinement
from . import regularizers as regularizers
from . import trainer as trainer
from .cameras.options import CameraRefinement as CameraRefinement
from .cameras.refined import RefinedCameras as RefinedCameras
from .config import FitConfig as FitConfig
from .loop import fit as fit
from .motion import Motion as Motion
from .motion import VertexOptimizerConfig as VertexOptimizerConfig
from .positions import StepReport as StepReport
from .positions import VertexOptimizer as VertexOptimizer
from .processes import Processes as Processes
from .records.evaluation import Evaluation as Evaluation
from .records.evaluation import evaluate as evaluate
from .records.progress import ProgressDisplay as ProgressDisplay
from .records.result import FitResult as FitResult
from .records.result import Picture as Picture
from .records.result import Progress as Progress
from .records.result import Reconstruction as Reconstruction
from .records.tensorboard import TensorBoardLogger as TensorBoardLogger
from .refinement.exchange import Exchange as Exchange
from .refinement.exchange import Grow as Grow
from .refinement.star import Star as Star
from .refinement.strategy import EmptySpace as EmptySpace
from .refinement.strategy import Moment as Moment
from .refinement.strategy import Refinement as Refinement
from .refinement.strategy import Situation as Situation
from .refinement.strategy import Strategy as Strategy
from .regularizers import shape_barrier as shape_barrier
from .regularizers import softplus_regularizer as softplus_regularizer

__all__ = [
    "CameraRefinement",
    "EmptySpace",
    "Evaluation",
    "Exchange",
    "FitConfig",
    "FitResult",
    "Grow",
    "Moment",
    "Motion",
    "Picture",
    "Processes",
    "Progress",
    "ProgressDisplay",
    "Reconstruction",
    "RefinedCameras",
    "Refinement",
    "Situation",
    "Star",
    "StepReport",
    "Strategy",
    "TensorBoardLogger",
    "VertexOptimizer",
    "VertexOptimizerConfig",
    "evaluate",
    "fit",
    "shape_barrier",
    "softplus_regularizer",
]
