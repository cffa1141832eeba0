"""Differentiable volume rendering of tetrahedral meshes."""
