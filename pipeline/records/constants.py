"""All constants of a system, and its start, as lists: whoever reads the data can rebuild it without this package."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record
from stickslip.sim.systems.drive import Harmonic, Piecewise

_of_block = partial(Column, "numbers", along="block")
_of_entry = partial(Column, along="constant_entry")
#: What a harmonic force has of each block, and the dimension of each.
_HARMONIC = {"amplitude": "force", "frequency": "angular_frequency", "phase": ""}


class Constants(Record):
    """The constants of the system and the start, as drawn, read or made, and moved where the member is a copy."""

    name = "constants"
    words = "whether to keep every constant of the system, and the start, as lists"
    takes_load = True
    needs = frozenset({"system"})
    columns = (
        _of_entry("wholes", "constant_row", "i of each entry of K that is not zero, from 0", is_index=True),
        _of_entry("wholes", "constant_column", "j of each", is_index=True),
        _of_entry("numbers", "constant_stiffness", "K_ij", dimension="stiffness"),
        _of_block("constant_damping", "R of each block: the diagonal of the damping matrix", dimension="damping"),
        Column(
            "numbers",
            "constant_cross_damping",
            "the others of a full damping matrix, row by row; else null",
            along="constant_cross_entry",
            dimension="damping",
        ),
        _of_block("constant_friction", "kinetic friction of each block", dimension="force"),
        _of_block("constant_static", "static friction of each block", dimension="force"),
        _of_block("constant_mass", "mass of each block", dimension="mass"),
        _of_block(
            "constant_belt_speed", "speed of the belt under each block; null if it changes in time", dimension="speed"
        ),
        *(
            _of_block(
                f"constant_force_{name}",
                f"{name} of the force on each block; null unless one is harmonic",
                dimension=dimension,
            )
            for name, dimension in _HARMONIC.items()
        ),
        _of_block("constant_ratio", "stiffness ratio r_i of each block; null of an engine without"),
        _of_block("constant_z0", "displacement of each block at t = 0", dimension="length"),
        _of_block("constant_w0", "velocity of each block at t = 0", dimension="speed"),
    )

    def of(self, result: Made) -> dict[str, Any]:
        system, member = result.system, result.member
        row, column = system.stiffness.nonzero()
        (z, w), waves = result.start, [term for term in system.force if isinstance(term, Harmonic)]
        lists = {
            "damping": system.damping,
            "friction": system.friction,
            "static": system.static,
            "mass": system.mass,
            "belt_speed": None if isinstance(system.belt_speed, Piecewise) else system.belt_speed,
            "ratio": member.ratios() if "ratio" in dict(member.settings) else None,
            "z0": z,
            "w0": w,
        }
        if len(waves) == 1:
            lists |= {f"force_{name}": getattr(waves[0], name) for name in _HARMONIC}
        cross = None if system.cross_damping is None else system.damping_matrix - np.diag(system.damping)
        lists = {name: values for name, values in lists.items() if values is not None}
        return {
            "constant_row": row.astype(np.int32),
            "constant_column": column.astype(np.int32),
            "constant_stiffness": np.asarray(system.stiffness[row, column]).ravel(),
            "constant_cross_damping": None if cross is None else np.asarray(cross).ravel(),
        } | {f"constant_{name}": np.broadcast_to(values, system.n) for name, values in lists.items()}
