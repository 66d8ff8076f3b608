"""Layout of the TORCS 1.3.7 structures that the physics reads and writes (amd64).

Only the members that are used have names; the rest is padding. Sizes and offsets are those of the package's binaries,
and the sizes are asserted when this is imported.
"""

from __future__ import annotations

import ctypes
from typing import Any


def _structure(name: str, size: int, members: dict[str, tuple[int, Any]]) -> type[ctypes.Structure]:
    """A structure of ``size`` bytes whose members lie at the given offsets."""
    fields: list[tuple[str, Any]] = []
    end = 0
    for member, (offset, kind) in sorted(members.items(), key=lambda item: item[1][0]):
        assert offset >= end, f"{name}.{member} overlaps what lies before it"
        if offset > end:
            fields.append((f"_{end}", ctypes.c_char * (offset - end)))
        fields.append((member, kind))
        end = offset + ctypes.sizeof(kind)
    if size > end:
        fields.append((f"_{end}", ctypes.c_char * (size - end)))
    structure = type(name, (ctypes.Structure,), {"_fields_": fields})
    assert ctypes.sizeof(structure) == size, f"{name} has {ctypes.sizeof(structure)} bytes, TORCS' has {size}"
    return structure


#: x, y, z and ax, ay, az: a pose, a velocity or an acceleration.
Vector = ctypes.c_float * 6
Wheel = _structure("Wheel", 88, {"spin": (24, ctypes.c_float)})  # rad/s

TrackSegment = _structure(
    "TrackSegment",
    264,
    {
        "type": (12, ctypes.c_int),
        "length": (24, ctypes.c_float),  # m
        "width": (28, ctypes.c_float),  # m
        "from_start": (40, ctypes.c_float),  # m, of its start along the centre line
        "radius": (44, ctypes.c_float),  # m
        "arc": (56, ctypes.c_float),  # rad
        "heading": (120, ctypes.c_float),  # rad, at its start
        "next": (232, ctypes.c_void_p),
    },
)
#: Types of a segment.
RIGHT, LEFT, STRAIGHT = 1, 2, 3

TrackStructure = _structure(
    "TrackStructure",
    248,
    {
        "n_segments": (48, ctypes.c_int),
        "length": (56, ctypes.c_float),  # m
        "width": (60, ctypes.c_float),  # m
        "last_segment": (144, ctypes.c_void_p),  # of a ring
    },
)

LocalPosition = _structure(
    "LocalPosition",
    32,
    {
        "segment": (0, ctypes.c_void_p),
        "type": (8, ctypes.c_int),
        "to_start": (12, ctypes.c_float),  # m on straights, rad in curves
        "to_right": (16, ctypes.c_float),  # m
        "to_middle": (20, ctypes.c_float),  # m, positive to the left
        "to_left": (24, ctypes.c_float),  # m
    },
)

CarStructure = _structure(
    "CarStructure",
    2672,
    {
        "skill_level": (4 + 140, ctypes.c_int),
        "pose": (328, Vector),
        "velocity": (328 + 24, Vector),  # m/s, in the car's frame
        "position": (328 + 216, LocalPosition),
        "car_handle": (840 + 8, ctypes.c_void_p),
        "wheels": (840 + 56, Wheel * 4),
        "gear": (840 + 504, ctypes.c_int),
        "fuel": (840 + 508, ctypes.c_float),  # l
        "engine_speed": (840 + 512, ctypes.c_float),  # rad/s
        "red_line": (840 + 516, ctypes.c_float),  # rad/s, of the engine
        "gear_ratios": (840 + 540, ctypes.c_float * 10),  # of reverse, neutral, 1, 2, …
        "n_gears": (840 + 580, ctypes.c_int),  # neutral included
        "damage": (840 + 656, ctypes.c_int),
        "steer": (1536, ctypes.c_float),
        "accelerator": (1540, ctypes.c_float),
        "brake": (1544, ctypes.c_float),
        "clutch": (1548, ctypes.c_float),
        "gear_command": (1552, ctypes.c_int),
    },
)

SituationStructure = _structure(
    "SituationStructure",
    64,
    {
        "n_cars": (0, ctypes.c_int),
        "race_state": (8, ctypes.c_int),
        "max_damage": (16, ctypes.c_float),
        "delta_time": (32, ctypes.c_double),  # s
        "current_time": (40, ctypes.c_double),  # s
        "cars": (56, ctypes.c_void_p),
    },
)
#: Race states: not started, running, and waiting for the start, in which the engine turns and the car stays.
PLACED, RUNNING, PRESTART = 0x00, 0x01, 0x10

RaceStructure = _structure(
    "RaceStructure",
    400,
    {"car_list": (0, ctypes.c_void_p), "situation": (8, ctypes.c_void_p), "track": (16, ctypes.c_void_p)},
)
