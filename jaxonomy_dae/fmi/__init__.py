"""Models for other tools and from them: Functional Mock-up Units, and functions of JAX written in C."""

from .export import export_fmu as export_fmu
from .imported import FmuComponent as FmuComponent
from .plain_c import write_c as write_c
from .to_casadi import to_casadi as to_casadi
