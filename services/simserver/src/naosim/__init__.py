"""An exact and fast embedded simulator of rcssserver3d's NAO robots."""

from __future__ import annotations

from naosim import robots
from naosim.batch import BatchSimulator, Perceptors, Truth, centre_of_mass
from naosim.client import RemoteBatch, ServerLostError
from naosim.launcher import Address, ProcessLauncher

__all__ = [
    "Address",
    "BatchSimulator",
    "Perceptors",
    "ProcessLauncher",
    "RemoteBatch",
    "ServerLostError",
    "Truth",
    "centre_of_mass",
    "robots",
]
__version__ = "0.1.0"
