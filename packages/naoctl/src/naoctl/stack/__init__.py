"""The service on one machine: its processes, ports and health checks. Needs neither a container nor root."""

from __future__ import annotations
