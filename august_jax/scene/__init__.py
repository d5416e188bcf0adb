"""What flies: airframes, their poses and flights, and the 5-D cloud that describes them."""

from august_jax.scene.airframes import (
    AIRFRAMES,
    Airframe,
    load_airframe,
    mesh_path,
    procedural_airframe,
    resolve_airframe,
    sample_triangles,
)
from august_jax.scene.cloud import WorldCloud, from_cloud, position_estimate, to_cloud
from august_jax.scene.mesh_files import MeshSource
from august_jax.scene.pose import random_rotation, rotation_from_euler, rotation_from_quaternion, tilt, transform
from august_jax.scene.rotorcraft import Rotorcraft, rotorcraft
from august_jax.scene.scenario import Scenario, draw_scenario, pose_scenario
from august_jax.scene.trajectory import Flight, fly, fly_many

__all__ = [
    "AIRFRAMES",
    "Airframe",
    "Flight",
    "MeshSource",
    "Rotorcraft",
    "Scenario",
    "WorldCloud",
    "draw_scenario",
    "fly",
    "fly_many",
    "from_cloud",
    "load_airframe",
    "mesh_path",
    "pose_scenario",
    "position_estimate",
    "procedural_airframe",
    "random_rotation",
    "resolve_airframe",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "rotorcraft",
    "sample_triangles",
    "tilt",
    "to_cloud",
    "transform",
]
