"""Equations that no component wrote: linear and nonlinear solves, steps, their adjoint, events."""
