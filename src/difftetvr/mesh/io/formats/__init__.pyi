from . import abaqus as abaqus
from . import bintet as bintet
from . import data as data
from . import exodus as exodus
from . import gmsh as gmsh
from . import medit as medit
from . import npz as npz
from . import ovm as ovm
from . import table as table
from . import tetgen as tetgen
from . import through_meshio as through_meshio
from . import unsupported as unsupported
from . import vtk as vtk
from . import xdmf as xdmf

__all__: list[str] = []
