"""A craft taken apart into what turns and what does not: the hull, and each rotor about its own axis."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from august_jax.scene.airframes import Airframe
from august_jax.scene.rotors import rotor_faces

if TYPE_CHECKING:
    import trimesh

_MOST_BLADES = 6


class Rotorcraft(NamedTuple):
    """A craft's parts; all axes are those of the craft.

    Attributes:
        hull: the craft without its rotors, in the craft's own frame.
        rotors: R rotors, each about its centre, so that it turns about z through its own origin.
        centres_m: where the centres are in the craft's frame (R, 3) [m].
        hands: +1 for rotors whose pitch lifts when they turn anticlockwise seen from above, -1 for clockwise (R,).
        blades: blades of each (R,), from the symmetry of its surface.
        radii_m: from the axis to the tips (R,) [m].
    """

    hull: Airframe
    rotors: tuple[Airframe, ...]
    centres_m: Float[np.ndarray, "R 3"]
    hands: Int[np.ndarray, " R"]
    blades: Int[np.ndarray, " R"]
    radii_m: Float[np.ndarray, " R"]


def rotorcraft(airframe: Airframe) -> Rotorcraft:
    """The parts of an airframe whose rotor axes are known and whose rotors are pieces of their own.

    Args:
        airframe: with ``rotor_axes_m``, as procedural ones have; of a loaded mesh give them by ``dataclasses.replace``.

    Raises:
        ValueError: the axes are not known, or at one of them no piece of the surface turns freely.
    """
    if airframe.rotor_axes_m is None:
        raise ValueError(
            f"airframe: {airframe.name} names no rotor axes; give the centres of its rotors (R, 3) in m, e.g. "
            "dataclasses.replace(airframe, rotor_axes_m=centres)"
        )
    centres = np.asarray(airframe.rotor_axes_m, float)
    vertices, faces = np.asarray(airframe.mesh.vertices), np.asarray(airframe.mesh.faces)
    turning = rotor_faces(vertices, faces, centres)
    if any(not each.any() for each in turning):
        row = next(row for row, each in enumerate(turning) if not each.any())
        raise ValueError(
            f"airframe: no piece of {airframe.name} turns about the axis at {np.round(centres[row], 3).tolist()} m; "
            "its rotors must be pieces of their own, and the axes through their middles"
        )
    rotors = []
    for row, (chosen, centre) in enumerate(zip(turning, centres)):
        surface = _piece(airframe.mesh, chosen)
        surface.apply_translation(-centre)
        rotors.append(Airframe(f"{airframe.name}, rotor {row}", surface, airframe.half_wheelbase_m))
    hull = Airframe(
        f"{airframe.name} without rotors", _piece(airframe.mesh, ~np.any(turning, axis=0)), airframe.half_wheelbase_m
    )
    hands, blades, radii = zip(*(_described(each.mesh) for each in rotors))
    return Rotorcraft(hull, tuple(rotors), centres, np.array(hands), np.array(blades), np.array(radii))


def _piece(mesh: trimesh.Trimesh, chosen: np.ndarray) -> trimesh.Trimesh:
    return mesh.submesh([np.flatnonzero(chosen)], append=True, repair=False)


def _described(mesh: trimesh.Trimesh) -> tuple[int, int, float]:
    """Hand, blades and radius of a rotor about z.

    A blade that goes ahead lifts where its leading edge is higher: its surface's normal, taken upwards, leans back,
    n_z n_phi < 0 for one that turns anticlockwise, on its upper side and on its lower alike. B blades repeat after a
    B-th of a turn: sum A r^2 e^{j n phi} is zero but for multiples n of B.
    """
    middle, area, normal = mesh.triangles_center, mesh.area_faces, mesh.face_normals
    reach = np.hypot(middle[:, 0], middle[:, 1])
    turned = (middle[:, 0] * normal[:, 1] - middle[:, 1] * normal[:, 0]) / np.maximum(reach, 1e-12)
    hand = 1 if np.sum(area * reach * turned * normal[:, 2]) < 0.0 else -1
    angle = np.arctan2(middle[:, 1], middle[:, 0])
    orders = np.arange(2, _MOST_BLADES + 1)
    lobes = np.abs(np.exp(1j * np.outer(orders, angle)) @ (area * reach**2))
    blades = int(orders[np.argmax(lobes > 0.5 * lobes.max())])
    return hand, blades, float(np.hypot(*np.asarray(mesh.vertices)[:, :2].T).max())
