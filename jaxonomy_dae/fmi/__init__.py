"""Models for other tools: Functional Mock-up Units, and functions of JAX written in C."""

from .export import export_fmu as export_fmu
