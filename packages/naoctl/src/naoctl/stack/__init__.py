"""The whole service on one machine: processes, ports, health and an orderly end. Needs neither a container nor root."""

from __future__ import annotations
