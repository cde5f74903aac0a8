"""A bridge of four diodes, by brute force over its modes."""

import itertools

import numpy as np

RON, GOFF = 0.05, 1e-3


def bridge_by_brute_force(source, v_load, R=None, goff=GOFF, knee=0.0):
    """(potentials, currents, conducting) of a bridge whose output is held at v_load, or loaded by R.

    The sixteen modes of four diodes, and the one in which none contradicts itself. Nodes: 0 the source's other end,
    1 its end behind Rs = 1, 2 the positive and 3 the negative rail.
    """
    ends = [(1, 2), (0, 2), (3, 1), (3, 0)]
    fits = []
    for modes in itertools.product((False, True), repeat=4):
        # Unknowns: potentials of nodes 1, 2, 3 and the current out of the load's source.
        A, b = np.zeros((4, 4)), np.zeros(4)
        A[0, 0], b[0] = 1.0, source  # (source − v1)/Rs flows into node 1
        conductances = np.array([1 / RON if on else goff for on in modes])
        offsets = np.array([goff * knee - knee / RON if on else 0.0 for on in modes])
        for (p, n), conductance, offset in zip(ends, conductances, offsets, strict=True):
            for node, other, sign in ((p, n, 1), (n, p, -1)):
                if node:
                    b[node - 1] -= sign * offset
                    A[node - 1, node - 1] += conductance
                    if other:
                        A[node - 1, other - 1] -= conductance
        A[1, 3], A[2, 3] = 1.0, -1.0  # the load takes a current from 2 to 3
        A[3, 1], A[3, 2], A[3, 3] = 1.0, -1.0, 0.0 if R is None else -R
        b[3] = v_load
        v1, v2, v3, i = np.linalg.solve(A, b)
        node = [0.0, v1, v2, v3]
        voltage = np.array([node[p] - node[n] for p, n in ends])
        if all((v - knee >= -1e-12) if on else (v - knee <= 1e-12) for v, on in zip(voltage, modes, strict=True)):
            fits.append((np.array(node), i, voltage * conductances + offsets, modes))
    return fits[0]
