from . import array as array
from . import data_exchange as data_exchange
from . import meta_folder as meta_folder
from . import own_files as own_files
from . import table as table

__all__: list[str] = []
