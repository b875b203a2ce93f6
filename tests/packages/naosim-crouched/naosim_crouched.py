"""Two robots that crouch deeper: an example of robots that a package of its own adds to naosprint."""

from __future__ import annotations

import dataclasses
from types import MappingProxyType

import numpy as np
from naosim import robots
from naosim.robots.booster import T1Parameters

nao = robots.get("nao-0")
crouch = {f"{side}lj{joint}": np.deg2rad(angle) for side in "lr" for joint, angle in ((3, 45.0), (4, -90.0), (5, 45.0))}
NAO = dataclasses.replace(
    nao,
    name="nao-crouched",
    title="NAO type 0, crouched",
    nominal_rad={**nao.nominal_rad, **crouch},
    action_range_rad={joint.name: 0.75 for joint in nao.joints if joint.actuated},
)


class SoftParameters(T1Parameters):
    """Motor gains of a T1 with softer knees."""

    DEFAULT_KP = MappingProxyType({**T1Parameters.DEFAULT_KP, "knee_pitch": 100.0})


t1 = robots.get("t1")
bend = {
    f"{side}_{joint}": angle
    for side in ("left", "right")
    for joint, angle in (("hip_pitch", -0.3), ("knee_pitch", 0.6), ("ankle_pitch", -0.3))
}
T1 = dataclasses.replace(
    t1,
    name="t1-crouched",
    title="Booster T1, crouched",
    nominal_rad={**t1.nominal_rad, **bend},
    parameters=SoftParameters(),
)
