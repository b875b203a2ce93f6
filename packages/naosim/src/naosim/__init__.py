"""Humanoid robots and the simulators they run in.

- :mod:`naosim.robots`: descriptions of robots, found by name.
- :mod:`naosim.kinds`: simulators, found by name; :mod:`naosim.simulator` is the interface of all of them.
- :mod:`naosim.conformance`: checks of a simulator against that interface.
- :mod:`naosim.simspark`: rcssserver3d's NAO, in an exact embedded engine and on servers.
- :mod:`naosim.launchers`: servers as processes or containers.

Importing the package, the robots or the interface loads no simulator.
"""

from __future__ import annotations

__version__ = "0.2.0"
