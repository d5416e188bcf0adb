"""Mesh files read without losing a face: OBJ, STL, PLY, glTF and COLLADA, their units and their axes."""

from august_jax.scene.mesh_files.frame import AUTO, AXES, UNITS_M, MeshSource
from august_jax.scene.mesh_files.read import FORMATS, read_mesh
from august_jax.scene.mesh_files.surface import Surface

__all__ = ["AUTO", "AXES", "FORMATS", "UNITS_M", "MeshSource", "Surface", "read_mesh"]
