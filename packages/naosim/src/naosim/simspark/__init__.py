"""rcssserver3d's NAO robots: the exact embedded engine, the network protocol, its client and a stand-in server.

Names are imported when they are first used, so that parameters of simulators can be read without the compiled engine.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from naosim.simspark.batch import BatchSimulator, Perceptors, centre_of_mass
    from naosim.simspark.client import RemoteBatch
    from naosim.simspark.embedded import EmbeddedSimulator
    from naosim.simspark.program import RCSSSERVER3D, embedded_launcher, server_launcher
    from naosim.simspark.remote import RemoteSimulator

__all__ = [
    "RCSSSERVER3D",
    "BatchSimulator",
    "EmbeddedSimulator",
    "Perceptors",
    "RemoteBatch",
    "RemoteSimulator",
    "centre_of_mass",
    "embedded_launcher",
    "server_launcher",
]

_MODULES = {
    "batch": ("BatchSimulator", "Perceptors", "centre_of_mass"),
    "client": ("RemoteBatch",),
    "embedded": ("EmbeddedSimulator",),
    "program": ("RCSSSERVER3D", "embedded_launcher", "server_launcher"),
    "remote": ("RemoteSimulator",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value
