"""The manifest of the layered standard FMI-LS-DAE: algebraic variables, and equations with their derivatives.

Source: modelica/fmi-ls-dae, version 0.0.1 of April 2026, a draft.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

PATH = "extra/org.fmi-standard.fmi-ls-dae/fmi-ls-manifest.xml"
VERSION = "0.0.1"


class Formulation(NamedTuple):
    """A residual: its variable, how often its equation must be differentiated until all derivatives follow, and the
    variables that it depends on."""

    place: int
    index: int
    dependencies: Sequence[int]


def manifest(
    algebraics: Sequence[int], slopes: Mapping[int, Sequence[int]], residuals: Sequence[Sequence[Formulation]]
) -> str:
    """The XML text. `slopes` has what the derivatives of states depend on; `residuals` groups each equation with its
    derivatives."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<fmiLayeredStandardManifest xmlns:fmi-ls="http://fmi-standard.org/fmi-ls-manifest" '
        f'fmi-ls:fmi-ls-name="org.fmi-standard.fmi-ls-dae" fmi-ls:fmi-ls-version="{VERSION}" '
        'fmi-ls:fmi-ls-description="Layered standard for DAE support in FMI">',
        "  <AlgebraicVariables>",
        *(f'    <AlgebraicVariable valueReference="{k}"/>' for k in algebraics),
        "  </AlgebraicVariables>",
        "  <ModelStructure>",
        *(f'    <ContinuousStateDerivative valueReference="{k}"{_on(own)}/>' for k, own in slopes.items()),
    ]
    for group in residuals:
        lines.append("    <Residual>")
        lines += [
            f'      <Formulation valueReference="{f.place}" index="{f.index}"{_on(f.dependencies)}/>' for f in group
        ]
        lines.append("    </Residual>")
    return "\n".join([*lines, "  </ModelStructure>", "</fmiLayeredStandardManifest>", ""])


def _on(dependencies: Sequence[int]) -> str:
    return f' dependencies="{" ".join(map(str, dependencies))}"'
