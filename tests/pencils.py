"""Random regular pencils for hypothesis: linear DAEs of known index in Weierstrass form (`shared_models.Pencil`)."""

import hypothesis.strategies as st
import numpy as np
from shared_models import Pencil


@st.composite
def invertible(draw, n: int, mixed: bool):
    """A product of a permutation and, if mixed, triangular integer matrices with unit diagonals."""
    out = np.eye(n, dtype=int)[list(draw(st.permutations(range(n))))]
    if mixed:
        entry = st.integers(-1, 1)
        lower, upper = np.eye(n, dtype=int), np.eye(n, dtype=int)
        for i in range(n):
            for k in range(i):
                lower[i, k], upper[k, i] = draw(entry), draw(entry)
        out = lower @ out @ upper
    return tuple(map(tuple, out.tolist()))


@st.composite
def pencils(draw, mixed=True, largest=4):
    d = draw(st.integers(0, 2))
    blocks = draw(
        st.lists(st.integers(1, 3), min_size=0 if d else 1, max_size=2).filter(lambda b: d + sum(b) <= largest)
    )
    n = d + sum(blocks)
    small = st.integers(-1, 1)
    row = st.lists(small, min_size=d, max_size=d).map(tuple)
    return Pencil(
        tuple(draw(st.lists(row, min_size=d, max_size=d))),
        tuple(blocks),
        tuple(draw(st.lists(st.tuples(small, small), min_size=sum(blocks), max_size=sum(blocks)))),
        draw(invertible(n, mixed)),
        draw(invertible(n, mixed)),
        tuple(draw(st.permutations(range(n)))),
        tuple(draw(st.permutations(range(n)))),
    )
