"""`modelDescription.xml` of FMI 2.0: variables are scalars, numbered from one; event indicators are counted."""

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

from .description import LOG_CATEGORIES, Structure, Variable, in_xml, of_number, of_variable, unit_definitions


def model_description_2(
    model: str, identifier: str, token: str, variables: Sequence[Variable], structure: Structure, indicators: int,
    completed: bool, co_simulation: bool, sources: Sequence[str], stop: float, tolerance: float,
) -> str:  # fmt: skip
    """The XML text; the place of a variable is its value reference. `completed` says whether integrators must tell
    of completed steps; `sources` are the files to compile."""
    abilities = (
        f'modelIdentifier="{identifier}" canGetAndSetFMUstate="true" canSerializeFMUstate="true" '
        'providesDirectionalDerivative="true"'
    )
    files = [f'      <File name="{name}"/>' for name in sources]
    listed = ["    <SourceFiles>", *files, "    </SourceFiles>"]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(model)} guid="{token}" '
        f'generationTool="jaxonomy_dae" variableNamingConvention="structured" numberOfEventIndicators="{indicators}">',
        f'  <ModelExchange {abilities} completedIntegratorStepNotNeeded="{str(not completed).lower()}">',
        *listed,
        "  </ModelExchange>",
    ]
    if co_simulation:
        step = 'canHandleVariableCommunicationStepSize="true"'
        lines += [f"  <CoSimulation {abilities} {step}>", *listed, "  </CoSimulation>"]
    lines += [
        *unit_definitions(variables),
        LOG_CATEGORIES,
        f'  <DefaultExperiment startTime="0" stopTime="{in_xml(stop)}" tolerance="{in_xml(tolerance)}"/>',
        "  <ModelVariables>",
        *(
            f"    <ScalarVariable {' '.join(of_variable(k, v))}><Real {' '.join(of_number(v, 1))}/></ScalarVariable>"
            for k, v in enumerate(variables)
        ),
        "  </ModelVariables>",
        "  <ModelStructure>",
    ]
    # Knowns of this version are the time, states and inputs: parameters are constant while it runs.
    states = {v.derivative for v in variables if v.derivative is not None}
    knowns = {k for k, v in enumerate(variables) if k in states or v.causality in ("independent", "input")}
    outputs = [k for k, v in enumerate(variables) if v.causality == "output"]
    for tag, group in (
        ("Outputs", {k: structure.outputs[k] for k in outputs}), ("Derivatives", structure.derivatives),
        ("InitialUnknowns", dict.fromkeys(structure.initial)),
    ):  # fmt: skip
        unknowns = []
        for place, dependencies in group.items():
            own = [] if dependencies is None else [str(k + 1) for k in dependencies if k in knowns]
            listed_ones = "" if dependencies is None else f' dependencies="{" ".join(own)}"'
            unknowns.append(f'      <Unknown index="{place + 1}"{listed_ones}/>')
        lines += [f"    <{tag}>", *unknowns, f"    </{tag}>"] if unknowns else []
    return "\n".join([*lines, "  </ModelStructure>", "</fmiModelDescription>", ""])
