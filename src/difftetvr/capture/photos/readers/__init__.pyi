from . import camera_list as camera_list
from . import colmap as colmap
from . import colmap_binary as colmap_binary
from . import colmap_model as colmap_model
from . import colmap_text as colmap_text
from . import foreign as foreign
from . import phone_apps as phone_apps
from . import ply_points as ply_points
from . import tiny_nerf as tiny_nerf
from . import transforms as transforms

__all__: list[str] = []
