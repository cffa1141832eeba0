from . import contents as contents
from . import edited_function as edited_function
from . import pace as pace
from . import panels as panels
from . import placement as placement
from . import quantities as quantities
from . import scene as scene
from . import server as server
from . import settings as settings
from . import shooting as shooting
from . import studio as studio
from . import watching as watching
from .contents import MeshContent as MeshContent
from .contents import VolumeContent as VolumeContent
from .scene import Scene as Scene
from .scene import Views as Views
from .server import Listening as Listening
from .server import LiveServer as LiveServer
from .settings import ScalarLook as ScalarLook
from .settings import Settings as Settings
from .watching import RunWatcher as RunWatcher

__all__ = [
    "Listening",
    "LiveServer",
    "MeshContent",
    "RunWatcher",
    "ScalarLook",
    "Scene",
    "Settings",
    "Views",
    "VolumeContent",
]
