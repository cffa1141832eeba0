"""Cells of all kinds that VTK has, in XML and legacy files: which are taken, as what, and which are not to be seen."""

import itertools

import numpy as np
import pytest

from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data
from tests.mesh.io.vtk_files import data_array, numbers, piece, vtu
